//! `uniground approach`: where a robot can stand to see or reach an object.

use super::output::print_json;
use super::resolve_scene;
use super::server::ServerArgs;
use crate::words;
use anyhow::bail;
use comfy_table::{Table, presets};
use std::io::{self, Write};
use uniground_types::approach::{
    Approach, ApproachRequest, ApproachStatus, FloorPoint, PlacedPose, Robot,
};
use uniground_types::placement::FrameChoice;
use uniground_types::scene::InstanceId;

#[allow(clippy::doc_markdown)] // Help is no Markdown.
#[derive(Debug, clap::Args)]
#[command(after_help = "Exit codes: 0 a pose was found; 1 none was found; 2 wrong usage.")]
pub struct ApproachArgs {
    /// The object to approach, in plain English
    #[arg(value_name = "QUESTION", required_unless_present_any = ["instance", "unseen_region"])]
    query: Option<String>,
    /// Scene of the server: its name, its id, or the beginning of one of them
    #[arg(long, value_name = "SCENE")]
    scene: String,
    /// Approach this instance of an earlier answer instead of asking a question
    #[arg(long, value_name = "ID", conflicts_with = "query")]
    instance: Option<u32>,
    /// Look at this part of the room that no camera saw, from the `coverage` of an answer
    #[arg(long, value_name = "NUMBER", conflicts_with_all = ["query", "instance"])]
    unseen_region: Option<u32>,
    /// Least confidence of the answer to the question; 0 approaches guesses, too [default: 0.7]
    #[arg(long, value_name = "0..1", conflicts_with_all = ["instance", "unseen_region"])]
    min_confidence: Option<f32>,
    /// Radius of the robot's footprint, meters
    #[arg(long, value_name = "METERS", default_value_t = 0.25)]
    radius: f32,
    /// Height of the robot, meters
    #[arg(long, value_name = "METERS", default_value_t = 1.3)]
    height: f32,
    /// Height of its camera above the floor, meters [default: 0.1 below its height]
    #[arg(long, value_name = "METERS")]
    eye_height: Option<f32>,
    /// Reach of its arm beyond the footprint, meters; without it the robot only has to see the
    /// object
    #[arg(long, value_name = "METERS")]
    reach: Option<f32>,
    /// Position of the robot, meters: only poses that it can drive to, with their paths
    #[arg(long, value_name = "X,Y", value_parser = floor_point, allow_hyphen_values = true)]
    from: Option<FloorPoint>,
    /// Coordinate frame of --from and of the printed poses
    #[arg(long, default_value = "scene", value_parser = words::frame())]
    frame: FrameChoice,
    /// Most poses to print
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=20))]
    max_poses: u32,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    server: ServerArgs,
}

fn floor_point(text: &str) -> Result<FloorPoint, String> {
    let numbers: Result<Vec<f64>, _> = text.split(',').map(|part| part.trim().parse()).collect();
    match numbers.as_deref() {
        Ok(&[x, y]) => Ok(FloorPoint { x, y, z: 0.0 }),
        Ok(&[x, y, z]) => Ok(FloorPoint { x, y, z }),
        _ => Err("expected two numbers, like 0.5,-1.0".into()),
    }
}

pub async fn run(args: &ApproachArgs) -> anyhow::Result<()> {
    let client = args.server.client()?;
    let scene = resolve_scene::resolve_id(&client, &args.scene).await?;
    let robot = Robot {
        radius_m: args.radius,
        height_m: args.height,
        eye_height_m: args.eye_height.unwrap_or((args.height - 0.1).max(0.05)),
        reach_m: args.reach,
    };
    let request = match (args.instance, args.unseen_region, &args.query) {
        (Some(id), ..) => ApproachRequest::for_instance(InstanceId(id), robot),
        (None, Some(number), _) => ApproachRequest::for_unseen_region(number, robot),
        (None, None, query) => ApproachRequest::for_query(query.clone().unwrap_or_default(), robot),
    };
    let request = ApproachRequest {
        min_confidence: args.min_confidence,
        from: args.from,
        frame: args.frame,
        max_poses: args.max_poses,
        ..request
    };
    let found = client.approach(&scene, &request).await?;
    match args.json {
        true => print_json(&found)?,
        false if found.poses.is_empty() => {}
        false => writeln!(io::stdout(), "{}", table_of(&found))?,
    }
    if found.status == ApproachStatus::Found {
        return Ok(());
    }
    bail!("no pose was found: {}", found.detail)
}

/// Poses, best first, in the frame that was asked for.
fn table_of(found: &Approach) -> Table {
    let mut table = Table::new();
    table.load_preset(presets::UTF8_FULL_CONDENSED);
    table.set_header(["Position (m)", "Yaw", "Distance", "In sight", "Path", "Why"]);
    let placed = found.in_frame.as_ref();
    for (i, pose) in found.poses.iter().enumerate() {
        let placed = placed.and_then(|frame| frame.poses.get(i));
        let [x, y, z] = placed.map_or(pose.position.map(f64::from), |placed| placed.position);
        let yaw_rad = placed.map_or(f64::from(pose.yaw_rad), PlacedPose::yaw_rad);
        table.add_row([
            format!("{x:.2}, {y:.2}, {z:.2}"),
            format!("{:.0}°", yaw_rad.to_degrees()),
            format!("{:.2} m", pose.distance_m),
            format!("{:.0} %", pose.visible_share * 100.0),
            pose.path_m.map_or_else(|| "-".into(), |path| format!("{path:.1} m")),
            pose.why.clone(),
        ]);
    }
    table
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_floor_point_has_two_or_three_numbers() {
        assert_eq!(floor_point("0.5, -1"), Ok(FloorPoint { x: 0.5, y: -1.0, z: 0.0 }));
        assert_eq!(floor_point("1,2,3"), Ok(FloorPoint { x: 1.0, y: 2.0, z: 3.0 }));
        assert!(floor_point("1").is_err() && floor_point("a,b").is_err());
    }
}
