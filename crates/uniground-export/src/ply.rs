//! Writes PLY, binary little endian: points in their own colors with the id of their thing, and the
//! things' names in the header.

use super::Export;
use std::io::{self, Write};
use uniground_geometry::scene::{self, Instance, InstanceId};

/// Maximum length of a name in a header, bytes.
const LONGEST_NAME: usize = 120;
/// Maximum length of all comments, bytes. Readers, including this project's own, accept headers of
/// 64 KiB. Names that do not fit are left out.
const MOST_COMMENT_BYTES: usize = 48 << 10;

/// Writes a scene as PLY: `x y z` (float), `red green blue` (uchar), `instance` (int, 0: none);
/// comments `instance <id> <name>`, in order of id.
///
/// # Errors
/// Returns errors of `out`.
pub fn write_ply(export: &Export, out: impl Write) -> io::Result<()> {
    let Export { title, cloud, points, things } = export;
    let positions: Vec<_> =
        points.iter().map(|(point, _)| cloud.positions[*point as usize]).collect();
    let of_point = |i: usize| {
        let (point, owner): (u32, InstanceId) = points[i];
        (cloud.colors[point as usize], Some(owner))
    };
    scene::write_ply(&comments(title, things), &positions, of_point, out)
}

fn comments(title: &str, things: &[&Instance]) -> Vec<String> {
    let mut comments = vec![format!("scene {}", to_header_text(title))];
    let mut bytes = 0;
    for (at, thing) in things.iter().enumerate() {
        let comment = format!("instance {} {}", thing.id, to_header_text(thing.label()));
        bytes += comment.len() + "comment \n".len();
        if bytes > MOST_COMMENT_BYTES {
            comments.push(format!("and {} more instances", things.len() - at));
            break;
        }
        comments.push(comment);
    }
    comments
}

/// Converts a name for a header: ASCII without line breaks. Other characters are written as
/// `\u{e9}`.
fn to_header_text(name: &str) -> String {
    let mut line = String::new();
    for c in name.chars() {
        let written = if c.is_ascii_graphic() || c == ' ' {
            c.to_string()
        } else {
            c.escape_unicode().to_string()
        };
        if line.len() + written.len() > LONGEST_NAME {
            break;
        }
        line.push_str(&written);
    }
    line
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::{Room, room};
    use camino::Utf8Path;
    use uniground_geometry::scene::read_instance_of_point;

    #[test]
    fn points_ids_and_names_are_read_back() {
        let Room { cloud, of_point, mut instances } = room();
        instances[1].given_name = Some("caf\u{e9}\ntable".into());
        let export = Export::new("r\u{f6}om", &cloud, &of_point, &instances, usize::MAX);
        let mut bytes = Vec::new();
        write_ply(&export, &mut bytes).unwrap();
        assert_eq!(read_instance_of_point(&*bytes).unwrap(), of_point);
        let folder = tempfile::tempdir().unwrap();
        let file = Utf8Path::from_path(folder.path()).unwrap().join("room.ply");
        std::fs::write(&file, &bytes).unwrap();
        assert_eq!(uniground_ingest::read_cloud(&file).unwrap(), cloud);
        let header = String::from_utf8_lossy(&bytes);
        let lines: Vec<&str> = header.lines().take_while(|line| *line != "end_header").collect();
        for expected in [
            "comment scene r\\u{f6}om",
            "comment instance 1 floor",
            "comment instance 2 caf\\u{e9}\\u{a}table",
            "property int instance",
        ] {
            assert!(lines.contains(&expected), "{expected}: {lines:?}");
        }
        assert!(lines.iter().all(|line| line.is_ascii()));
    }

    #[test]
    fn header_stays_within_the_size_that_readers_accept() {
        let Room { cloud, of_point, instances } = room();
        let name = Some("\u{1f6cb}".repeat(100));
        let many: Vec<Instance> = (1..=2000)
            .map(|id| Instance {
                id: InstanceId(id),
                given_name: name.clone(),
                ..instances[0].clone()
            })
            .collect();
        let mut bytes = Vec::new();
        write_ply(&Export::new("", &cloud, &of_point, &many, usize::MAX), &mut bytes).unwrap();
        assert!(bytes.len() < 60 << 10, "{}", bytes.len());
        assert!(bytes.windows(14).any(|window| window == b"more instances"));
        assert_eq!(read_instance_of_point(&*bytes).unwrap().len(), cloud.len());
    }
}
