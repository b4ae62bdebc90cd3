//! Files that hold all poses of a scan: one pose per line (4x4, 3x4, or a time with position and
//! quaternion), or Open3D's log with five lines per pose.

use super::files::TextFiles;
use super::numbers::{matrix_from_values, parse, pose_from_quaternion};
use super::pairing::to_seconds;
use crate::{IngestError, MAX_FRAMES};
use camino::Utf8Path;
use nalgebra::Matrix4;

/// Maximum size: the maximum number of poses, written with many decimals.
const MAX_BYTES: u64 = 64 << 20;

/// Poses in the order of the file.
pub(super) enum Trajectory {
    /// One pose per frame.
    Ordered(Vec<Matrix4<f64>>),
    /// Poses with the time of each.
    Timed(Vec<TimedPose>),
}

/// A pose of a moment.
#[derive(Debug, Clone)]
pub(super) struct TimedPose {
    pub time_s: f64,
    pub pose: Matrix4<f64>,
    /// The number of the picture, where the writing program adds one: RTAB-Map's node.
    pub id: Option<u64>,
}

/// Reads any of these formats. The number of values per line distinguishes them.
pub(super) fn read(root: &TextFiles, file: &Utf8Path) -> Result<Trajectory, IngestError> {
    let text = root.read_text(file, MAX_BYTES)?;
    let mut rows: Vec<Vec<f64>> = Vec::new();
    for (number, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || line.starts_with(['#', '%']) {
            continue;
        }
        match parse(line) {
            Ok(row) => rows.push(row),
            // A heading can name the columns. Any later line without numbers is damage.
            Err(_) if rows.is_empty() => {}
            Err(word) => {
                return Err(IngestError::malformed(
                    file,
                    format!("line {}: {word:?} is not a number", number + 1),
                ));
            }
        }
        // The maximum number of poses with five lines each, and many more than that: motion capture
        // runs at 200 Hz.
        if rows.len() > 100 * MAX_FRAMES {
            return Err(IngestError::malformed(file, "it has too many lines"));
        }
    }
    let strange = |n: usize| {
        IngestError::malformed(
            file,
            format!(
                "not a list of poses: its lines have {n} numbers, expected 7 or 8 (time, position, quaternion), 12 or 16 (matrix)"
            ),
        )
    };
    match rows.first().map_or(0, Vec::len) {
        3 => parse_log(&rows).map(Trajectory::Ordered).ok_or_else(|| {
            IngestError::malformed(
                file,
                "not a log of poses: expected three numbers, then four lines of four",
            )
        }),
        12 | 16 => {
            let poses = rows
                .iter()
                .map(|row| matrix_from_values(row).ok_or_else(|| strange(row.len())))
                .collect::<Result<_, _>>()?;
            Ok(Trajectory::Ordered(poses))
        }
        7 => {
            let pose = |row: &Vec<f64>| match row[..] {
                [x, y, z, qx, qy, qz, qw] => Ok(pose_from_quaternion([x, y, z], [qx, qy, qz, qw])),
                _ => Err(strange(row.len())),
            };
            rows.iter().map(pose).collect::<Result<_, _>>().map(Trajectory::Ordered)
        }
        8 | 9 => {
            let timed = |row: &Vec<f64>| match row[..] {
                [t, x, y, z, qx, qy, qz, qw, ..] => Ok(TimedPose {
                    time_s: to_seconds(t),
                    pose: pose_from_quaternion([x, y, z], [qx, qy, qz, qw]),
                    id: row
                        .get(8)
                        .filter(|id| **id >= 0.0 && id.fract() == 0.0)
                        .map(|id| *id as u64),
                }),
                _ => Err(strange(row.len())),
            };
            rows.iter().map(timed).collect::<Result<_, _>>().map(Trajectory::Timed)
        }
        n => Err(strange(n)),
    }
}

/// Parses Open3D's format: three numbers that are not needed, then a matrix.
fn parse_log(rows: &[Vec<f64>]) -> Option<Vec<Matrix4<f64>>> {
    rows.chunks(5)
        .map(|chunk| match chunk {
            [head, rest @ ..] if head.len() == 3 && rest.len() == 4 => {
                matrix_from_values(&rest.concat())
            }
            _ => None,
        })
        .collect()
}

/// Returns the pose nearest to a time, at most `within_s` away. Does not interpolate.
pub(super) fn pose_at(poses: &[TimedPose], time: f64, within_s: f64) -> Option<Matrix4<f64>> {
    let after = poses.partition_point(|pose| pose.time_s < time);
    let near = |i: Option<usize>| {
        i.and_then(|i| poses.get(i)).filter(|pose| (pose.time_s - time).abs() <= within_s)
    };
    let away = |pose: &TimedPose| (pose.time_s - time).abs();
    match (near(after.checked_sub(1)), near(Some(after))) {
        (Some(before), Some(next)) if away(next) <= away(before) => Some(next.pose),
        (Some(pose), _) | (None, Some(pose)) => Some(pose.pose),
        (None, None) => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn read_text_as(text: &str) -> Result<Trajectory, IngestError> {
        let folder = tempfile::tempdir().unwrap();
        let root = Utf8Path::from_path(folder.path()).unwrap();
        std::fs::write(root.join("t.txt"), text).unwrap();
        read(&TextFiles::new(root), Utf8Path::new("t.txt"))
    }

    #[test]
    fn all_pose_list_formats_give_the_same_pose() {
        let expected = Matrix4::new_translation(&nalgebra::Vector3::new(1.0, 2.0, 3.0));
        for text in [
            "1 0 0 1 0 1 0 2 0 0 1 3 0 0 0 1\n",
            "1 0 0 1 0 1 0 2 0 0 1 3\n",
            "1 2 3 0 0 0 1\n",
            "0 0 1\n1 0 0 1\n0 1 0 2\n0 0 1 3\n0 0 0 1\n",
            "# time x y z qx qy qz qw\n7.5 1 2 3 0 0 0 1\n",
            "timestamp,x,y,z,qx,qy,qz,qw\n7.5,1,2,3,0,0,0,1\n",
        ] {
            let found = match read_text_as(text).unwrap() {
                Trajectory::Ordered(poses) => poses[0],
                Trajectory::Timed(poses) => poses[0].pose,
            };
            assert_eq!(found, expected, "{text}");
        }
        assert!(read_text_as("1 2\n").is_err() && read_text_as("1 0 1\n1 0 0 1\n").is_err());
    }

    proptest! {
        #[test]
        fn random_text_never_panics(text in "[-0-9. e\\n#,]{0,300}") {
            let _ = read_text_as(&text);
        }
    }
}
