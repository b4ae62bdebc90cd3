//! Valid files with a few changed bytes: each gets a response, and the server stays up.

use crate::hostile_uploads::{ANY, ZIP};
use crate::test_scans::Scan;
use crate::test_server::wait_for_job;
use crate::{Form, Report, Target, since};
use las::{Builder, Point, Writer};
use std::collections::BTreeMap;
use std::io::Cursor;
use std::time::Instant;
use uniground_client::ClientError;

/// A seeded pseudo-random generator.
struct Dice(u64);

impl Dice {
    fn below(&mut self, most: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 % most as u64) as usize
    }
}

/// Returns a few hundred compressed points.
fn laz_file() -> Vec<u8> {
    let mut builder = Builder::from((1, 4));
    builder.point_format = las::point::Format::new(7).unwrap();
    builder.point_format.is_compressed = true;
    let mut writer = Writer::new(Cursor::new(Vec::new()), builder.into_header().unwrap()).unwrap();
    for i in 0..500 {
        let color = Some(las::Color::new(1000, 2000, 3000));
        let (x, y) = (f64::from(i % 25) * 0.1, f64::from(i / 25) * 0.1);
        writer
            .write_point(Point {
                x,
                y,
                z: 0.01 * x,
                color,
                gps_time: Some(0.0),
                ..Point::default()
            })
            .unwrap();
    }
    writer.close().unwrap();
    writer.into_inner().unwrap().into_inner()
}

/// Returns a complete depth image.
fn depth_picture(file: &str) -> Vec<u8> {
    let seeds = concat!(env!("CARGO_MANIFEST_DIR"), "/fuzz/seeds/depth/");
    std::fs::read(format!("{seeds}{file}")).unwrap()
}

pub async fn run(form: Form, report: &mut Report) {
    let glb = std::fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/fuzz/seeds/glb/one")).unwrap();
    let clouds = [(ANY, laz_file()), (ANY, glb), (ZIP, Scan::frames_only().zip())];
    let pictures =
        ["zip.exr", "zips.exr", "floats.tif", "packed.tif", "words.tif"].map(depth_picture);
    let target = Target::start();
    let client = &target.process.client;
    let (start, count) = (Instant::now(), form.of(40, 432));
    let mut dice = Dice(0x9e37_79b9_7f4a_7c15);
    let (mut answers, mut wrong) = (BTreeMap::<String, usize>::new(), 0);
    for number in 0..count {
        let mut change = |mut bytes: Vec<u8>| {
            for _ in 0..=dice.below(12) {
                let at = dice.below(bytes.len());
                bytes[at] = [0x00, 0xff, 0x7f, 0x80, dice.below(256) as u8][dice.below(5)];
            }
            bytes
        };
        let kind = number % (clouds.len() + pictures.len());
        let (media_type, upload) = if let Some((media_type, bytes)) = clouds.get(kind) {
            (*media_type, change(bytes.clone()))
        } else {
            let picture = change(pictures[kind - clouds.len()].clone());
            (
                ZIP,
                Scan::neutral()
                    .with("depth/0.png", picture)
                    .with("note.txt", format!("{number}"))
                    .zip(),
            )
        };
        let answer = match client.create_scene(None, media_type, upload).await {
            Err(ClientError::Problem(problem)) => problem.code,
            Ok(created) => {
                let job = wait_for_job(client, &created.job.unwrap().id).await;
                job.error.map_or_else(|| "parsed".into(), |error| error.code)
            }
            Err(other) => format!("{other}"),
        };
        wrong += usize::from(
            matches!(answer.as_str(), "internal" | "storage_failed" | "memory_short")
                || answer.contains(' '),
        );
        *answers.entry(answer).or_default() += 1;
    }
    let up = client.bytes("healthz").await.is_ok();
    let told: Vec<String> =
        answers.iter().map(|(answer, count)| format!("{answer} {count}")).collect();
    let case = format!("{count} files with a few bytes changed");
    report.row(
        &case,
        &format!("{wrong} wrong answers"),
        since(start),
        Some(target.peak_mb()),
        &told.join(", "),
        up && wrong == 0,
    );
}
