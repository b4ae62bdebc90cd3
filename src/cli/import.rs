//! `uniground import`: checks how a scan is read and converts it to the neutral layout.

mod archive;
mod page;

use crate::words;
use anyhow::{Context, ensure};
use camino::{Utf8Path, Utf8PathBuf};
use serde::Serialize;
use std::fs;
use std::io::{self, Write};
use std::time::Instant;
use uniground_core::geometry::boxes::Aabb;
use uniground_core::ingest::{self, InspectedScan, NeighborAgreement, ScanFolder};
use uniground_core::progress::Progress;
use uniground_core::render::{Orbit, ROOM_VIEW, RenderScene, draw_scene, encode_jpeg};
use uniground_core::scene::{FrameRef, ImportReport, PointCloud};
use uniground_types::findings::{Finding, FindingKind};
use uniground_types::geometry::up_axis::UpAxis;
use uniground_types::settings::{ImportSettings, LevellingChoice};

#[derive(Debug, clap::Args)]
pub struct ImportArgs {
    /// Scan to read: a folder, an archive, a .sens or .r3d file, a point cloud or a mesh
    scan: Utf8PathBuf,
    /// Check the files, the poses and all pictures, without fusing a point cloud
    #[arg(long)]
    check: bool,
    /// Write the scan in the neutral layout (scene.json): rectified pictures, leveled poses, Z up,
    /// meters
    #[arg(long, value_name = "FILE.zip", conflicts_with = "check")]
    out: Option<Utf8PathBuf>,
    /// Write an HTML page with pictures, and report.json, to this folder
    #[arg(long, value_name = "FOLDER")]
    report: Option<Utf8PathBuf>,
    /// Axis that points up in the scan: x, -x, y, -y, z or -z
    #[arg(long, allow_hyphen_values = true, value_parser = super::parse::up_axis)]
    up: Option<UpAxis>,
    /// Length of one unit of the scan's cloud and poses, meters
    #[arg(long, value_name = "METERS", value_parser = words::meters_per_unit)]
    metres_per_unit: Option<f64>,
    /// Keep the tilt of the scan instead of leveling it
    #[arg(long)]
    no_levelling: bool,
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
}

/// An imported scan with its report.
struct ImportedScanInfo {
    report: ImportReport,
    frames: Vec<FrameRef>,
    /// `None` if the scan was only checked and has no point cloud of its own.
    cloud: Option<PointCloud>,
    /// How well each frame agrees with the next; `None` if frames do not overlap.
    neighbours: Option<NeighborAgreement>,
    seconds: f32,
}

/// The JSON output: the import report and the additional checks of this command.
#[derive(Serialize)]
struct ImportOutput<'a> {
    #[serde(flatten)]
    report: &'a ImportReport,
    neighbours: Option<NeighborAgreement>,
    /// Full extent of the cloud, meters.
    extent_m: Option<[f32; 3]>,
}

impl<'a> ImportOutput<'a> {
    fn from_scan(imported: &'a ImportedScanInfo) -> Self {
        let extent = imported.cloud.as_ref().and_then(|cloud| Aabb::around(&cloud.positions));
        Self {
            report: &imported.report,
            neighbours: imported.neighbours,
            extent_m: extent.map(|extent| extent.size.into()),
        }
    }
}

pub fn run(args: &ImportArgs) -> anyhow::Result<()> {
    ensure!(args.scan.exists(), "{}: no such file or folder", args.scan);
    let settings = ImportSettings {
        up: args.up,
        metres_per_unit: args.metres_per_unit,
        levelling: if args.no_levelling { LevellingChoice::Off } else { LevellingChoice::Auto },
        ..ImportSettings::default()
    };
    let begun = Instant::now();
    let folder = ScanFolder::open(&args.scan)?;
    let scan = ingest::open(&folder.path)?;
    let InspectedScan { frames, cloud, report } = if args.check {
        ingest::check(&scan, &settings, &Progress::silent())?
    } else {
        let bundle = ingest::load(&scan, &settings, &Progress::silent())?;
        InspectedScan { frames: bundle.frames, cloud: Some(bundle.cloud), report: bundle.report }
    };
    let neighbours = ingest::compare_neighbors(&frames);
    let imported = ImportedScanInfo {
        report,
        frames,
        cloud,
        neighbours,
        seconds: begun.elapsed().as_secs_f32(),
    };
    if let Some(out) = &args.report {
        write_report(out, &args.scan, &imported)?;
    }
    if let (Some(out), Some(cloud)) = (&args.out, &imported.cloud) {
        archive::write(out, &imported.frames, cloud).with_context(|| format!("--out {out}"))?;
    }
    let mut stdout = io::stdout().lock();
    match args.json {
        true => {
            writeln!(
                stdout,
                "{}",
                serde_json::to_string_pretty(&ImportOutput::from_scan(&imported))?
            )?;
        }
        false => summary_lines(&imported)
            .iter()
            .try_for_each(|(what, value)| writeln!(stdout, "{what:<12} {value}"))?,
    }
    Ok(())
}

/// Returns the summary for the terminal as pairs of title and value.
fn summary_lines(
    ImportedScanInfo { report, cloud, seconds, neighbours, .. }: &ImportedScanInfo,
) -> Vec<(&'static str, String)> {
    let mut lines = vec![("read as", format!("{} in {seconds:.1} s", report.format))];
    let skipped = if report.frames_skipped > 0 {
        format!(", {} skipped", report.frames_skipped)
    } else {
        String::new()
    };
    lines.push(("frames", format!("{}{skipped}", report.frames)));
    if report.frames > 0 {
        let agreement = report
            .reprojection_agreement
            .map_or("unknown".into(), |a| format!("{:.0}% of the points in view", a * 100.0));
        lines.push((
            "depth fits",
            format!("{agreement} (poses {:?}, cameras {})", report.pose, report.camera_axes),
        ));
    }
    if let Some(NeighborAgreement { depth_error_m, drift_m, worst_drift_m, worst_after }) =
        neighbours
    {
        let [error, drift, worst] = [depth_error_m, drift_m, worst_drift_m].map(|m| m * 1000.0);
        lines.push((
            "neighbours",
            format!("depth differs by {error:.0} mm, poses drift by {drift:.0} mm from frame to frame; at most {worst:.0} mm, after frame {worst_after}"),
        ));
    }
    let level = match &report.levelling {
        Some(level) if level.turned => {
            format!("tilted by {:.1} degrees, turned level: {}", level.tilt_deg, level.evidence)
        }
        Some(level) => format!("level within {:.1} degrees: {}", level.tilt_deg, level.evidence),
        None => "not leveled".into(),
    };
    lines.push(("up", format!("{} ({level})", report.up.name())));
    if let Some(extent) = cloud.as_ref().and_then(|cloud| Aabb::around(&cloud.positions)) {
        let whose = if report.cloud_points.is_some() { "from the scan" } else { "fused" };
        let points = cloud.as_ref().map_or(0, PointCloud::len);
        lines.push((
            "cloud",
            format!(
                "{points} points ({whose}), {:.2} x {:.2} x {:.2} m",
                extent.size.x, extent.size.y, extent.size.z
            ),
        ));
    }
    if let Some(way) = report.source_to_scene.filter(|way| way.metres_per_unit != 1.0) {
        lines.push(("units", format!("{} m", way.metres_per_unit)));
    }
    lines.extend(report.findings.iter().map(finding_line));
    lines
}

/// Returns title and text of a finding.
fn finding_line(finding: &Finding) -> (&'static str, String) {
    let title = match finding.kind {
        _ if finding.warning => "warning",
        FindingKind::Read => "read",
        FindingKind::LeftOut => "not used",
        FindingKind::Assumed => "assumed",
        FindingKind::Changed => "changed",
        FindingKind::Unusual => "unusual",
    };
    let confidence = finding.confidence.map(|share| format!(" (confidence {:.0}%)", share * 100.0));
    (title, format!("{}{}", finding.text, confidence.unwrap_or_default()))
}

/// Rendered views of the cloud. The side view shows whether upright objects stand upright.
const VIEWS: [(&str, &str, Orbit); 3] = [
    ("room", "Into the room", ROOM_VIEW),
    (
        "side",
        "From the side (a level floor is a line)",
        Orbit { width: 1024, height: 600, azimuth_deg: -90.0, tilt_deg: 89.0 },
    ),
    ("top", "From above", Orbit { width: 1024, height: 768, azimuth_deg: -90.0, tilt_deg: 0.5 }),
];

fn write_report(
    out: &Utf8Path,
    scan: &Utf8Path,
    imported: &ImportedScanInfo,
) -> anyhow::Result<()> {
    ensure!(!out.as_str().is_empty(), "--report: the folder's name is empty");
    fs::create_dir_all(out).with_context(|| format!("--report {out}"))?;
    let mut pictures = Vec::new();
    if let Some((cloud, extent)) =
        imported.cloud.as_ref().and_then(|cloud| Some((cloud, Aabb::around(&cloud.positions)?)))
    {
        let scene = RenderScene::new(cloud.clone());
        for (name, title, orbit) in VIEWS {
            fs::write(
                out.join(format!("{name}.jpg")),
                encode_jpeg(&draw_scene(&scene, &extent, &orbit, &[])),
            )?;
            pictures.push((name, title));
        }
    }
    if let Some(sheet) = page::contact_sheet(&imported.frames) {
        fs::write(out.join("frames.jpg"), encode_jpeg(&sheet))?;
        pictures.push(("frames", "Sample frames"));
    }
    fs::write(
        out.join("report.json"),
        serde_json::to_vec_pretty(&ImportOutput::from_scan(imported))?,
    )?;
    fs::write(out.join("index.html"), page::render(scan, &summary_lines(imported), &pictures))?;
    Ok(())
}
