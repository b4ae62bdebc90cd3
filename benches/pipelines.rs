//! Steps of both stages on the sample scene, in process. `cargo bench --bench pipelines`

#![allow(missing_docs, clippy::unwrap_used)] // a bench that can not set up has nothing to time

use camino::Utf8Path;
use criterion::{Criterion, criterion_group, criterion_main};
use std::hint::black_box;
use std::time::Duration;
use uniground_core::geometry::boxes::Aabb;
use uniground_core::grounding::{NameIndex, Question, SceneView, ground};
use uniground_core::ingest;
use uniground_core::ingest::archive::{ArchiveKind, UnpackLimits, unpack};
use uniground_core::parsing::checkpoints::Checkpoints;
use uniground_core::parsing::evidence::{self, Picture};
use uniground_core::parsing::masks::MaskSource;
use uniground_core::parsing::masks::rgbd::RgbdMasks;
use uniground_core::parsing::{self, ParsingSettings, Perception, superpoints};
use uniground_core::progress::Progress;
use uniground_core::render::{ROOM_VIEW, RenderScene, draw_scene};
use uniground_core::scene::SceneBundle;
use uniground_types::settings::ImportSettings;

fn unpacked(folder: &Utf8Path) {
    let archive = Utf8Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/living_room.zip");
    unpack(&archive, ArchiveKind::Zip, folder, &UnpackLimits::default()).unwrap();
}

fn load(folder: &Utf8Path) -> SceneBundle {
    ingest::load(&ingest::open(folder).unwrap(), &ImportSettings::default(), &Progress::silent())
        .unwrap()
}

fn pipelines(c: &mut Criterion) {
    let temporary = tempfile::tempdir().unwrap();
    let folder = Utf8Path::from_path(temporary.path()).unwrap();
    unpacked(folder);
    let (bundle, settings, masks) =
        (load(folder), ParsingSettings::default(), RgbdMasks::default());
    let frames = bundle.frames.clone();
    let silent = Progress::silent();
    let parsed = parsing::parse(
        bundle.clone(),
        &Perception::with_masks(&masks),
        &settings,
        &Checkpoints::disabled(),
        &silent,
    )
    .unwrap();

    let mut group = c.benchmark_group("stage 1, sample scene");
    group.sample_size(10).measurement_time(Duration::from_secs(8));
    group.bench_function("import: check, decode, fuse the cloud", |b| {
        b.iter(|| load(black_box(folder)));
    });
    group.bench_function("superpoints", |b| {
        b.iter(|| superpoints::compute(&bundle.cloud, &settings.superpoints, &silent).unwrap());
    });
    let frame = frames[0].decode().unwrap();
    group.bench_function("rgbd masks, one frame", |b| {
        b.iter(|| masks.masks(black_box(&frame), &silent));
    });
    group.bench_function("parse: superpoints to views", |b| {
        b.iter(|| {
            parsing::parse(
                bundle.clone(),
                &Perception::with_masks(&masks),
                &settings,
                &Checkpoints::disabled(),
                &silent,
            )
            .unwrap()
        });
    });
    let instance = parsed.instances.iter().find(|instance| !instance.views.is_empty()).unwrap();
    let photograph = frames.iter().find(|frame| frame.index == instance.views[0].frame).unwrap();
    group.bench_function("evidence picture: decode, draw, encode", |b| {
        b.iter(|| {
            evidence::draw_picture(
                &photograph.decode_color().unwrap(),
                &instance.views[0],
                Picture::Frame,
            )
        });
    });
    group.finish();

    let mut group = c.benchmark_group("stage 2, sample scene");
    let scene = SceneView {
        instances: &parsed.instances,
        extent: parsed.extent,
        names: &NameIndex::of(&parsed.instances),
        appearance: None,
    };
    let question = |query: &str| Question::of(query);
    for query in ["the orange stool", "the bookcase between the red sofa and the desk"] {
        let question = question(query);
        group.bench_function(query, |b| b.iter(|| ground(scene, black_box(&question))));
    }
    let extent = Aabb::around(&parsed.cloud.positions).unwrap();
    group.sample_size(20);
    group.bench_function("picture of the room, 1024x768", |b| {
        b.iter(|| draw_scene(&RenderScene::new(parsed.cloud.clone()), &extent, &ROOM_VIEW, &[]));
    });
    group.finish();
}

criterion_group!(benches, pipelines);
criterion_main!(benches);
