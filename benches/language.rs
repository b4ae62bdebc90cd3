//! Parsing a question, deciding it over 200 and 5,000 instances, and the shortlist over embeddings:
//! `cargo bench --bench language`.

#![allow(missing_docs, clippy::unwrap_used)] // a bench that can not set up has nothing to time

use criterion::{Criterion, criterion_group, criterion_main};
use std::hint::black_box;
use uniground_core::geometry::boxes::Aabb;
use uniground_core::geometry::statistics::largest_indices;
use uniground_core::geometry::{Point3, Vector3};
use uniground_core::grounding::{NameIndex, Question, SceneView, ground};
use uniground_core::language::parse;
use uniground_core::models::attributes::Lexicon;
use uniground_core::scene::{Embeddings, Instance, PointCloud};
use uniground_evaluation::annotations::{Annotations, SceneObject};
use uniground_evaluation::systems::{NamedBy, instances_of};

const QUESTIONS: [&str; 9] = [
    "the black chair closest to the door",
    "this is a brown chair. it is at the end of the long table, next to the window and in front of the whiteboard.",
    "facing the desk with two monitors, the second monitor from the left",
    "bring me the red mug on the coffee table by the sofa",
    "something to sit on while working at the desk",
    "not the one by the door, the other bookcase between the sofa and the desk",
    "my back hurts, so I would rather have the chair beside the plant",
    "what is within 2 m of the desk?",
    "how far is the nearest chair from the door?",
];

/// Returns a hall of `count` instances of a dozen kinds on a grid, named by the encoder as in a
/// parsed scene.
fn hall(count: usize) -> Vec<Instance> {
    let nouns: Vec<_> = [
        "chair",
        "desk",
        "door",
        "sofa",
        "coffee table",
        "mug",
        "window",
        "bookcase",
        "whiteboard",
        "monitor",
        "plant",
        "stool",
    ]
    .iter()
    .map(|name| Lexicon::get().find(name).unwrap())
    .collect();
    let side = (count as f32).sqrt().ceil() as usize;
    let middle = |range: &uniground_core::models::attributes::Range| {
        f32::midpoint(range.low, range.high).max(0.02)
    };
    let object = |i: usize| {
        let noun = nouns[i % nouns.len()];
        let size = Vector3::new(middle(&noun.long), middle(&noun.short), middle(&noun.height));
        let base = middle(&noun.base);
        let center =
            Point3::new((i % side) as f32 * 1.5, (i / side) as f32 * 1.5, base + size.z / 2.0);
        let aabb = Aabb { center, size };
        SceneObject {
            id: i as u32 + 1,
            name: noun.name.clone(),
            aabb,
            rotated: None,
            cloud_points: 0,
            mean_rgb: None,
            colors: Vec::new(),
            seen_as: None,
        }
    };
    let annotations = Annotations { objects: (0..count).map(object).collect(), of_point: None };
    instances_of(&annotations, &PointCloud::default(), NamedBy::Encoder)
}

fn bench_parsing(c: &mut Criterion) {
    let mut group = c.benchmark_group("reading");
    for question in QUESTIONS {
        group.bench_function(question, |b| b.iter(|| parse(black_box(question))));
    }
    group.finish();
}

fn bench_deciding(c: &mut Criterion) {
    let mut group = c.benchmark_group("deciding");
    group.sample_size(20);
    for count in [200, 5000] {
        let instances = hall(count);
        let extent = Aabb::around(
            instances.iter().flat_map(|i| i.aabb.corners()).collect::<Vec<_>>().iter(),
        )
        .unwrap();
        let scene = SceneView {
            instances: &instances,
            extent,
            names: &NameIndex::of(&instances),
            appearance: None,
        };
        for query in QUESTIONS {
            let question = Question::of(query);
            group.bench_function(format!("{count}: {query}"), |b| {
                b.iter(|| ground(scene, black_box(&question)));
            });
        }
    }
    group.finish();
}

/// Finds the five instances nearest to a query of 1,024 dimensions, by exact cosines.
fn bench_shortlist(c: &mut Criterion) {
    const DIM: usize = 1024;
    let mut group = c.benchmark_group("shortlist");
    group.sample_size(10);
    for (count, cores) in [(10_000, 1), (1_000_000, 1), (1_000_000, 2)] {
        let row: Vec<f32> = (0..count * DIM)
            .map(|i| (i.wrapping_mul(2_654_435_761) % 1000) as f32 / 16_000.0 - 0.03)
            .collect();
        let embeddings = Embeddings::new(DIM, &row);
        let query = row[..DIM].to_vec();
        drop(row);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(cores).build().unwrap();
        group.bench_function(format!("{count} instances, {cores} cores"), |b| {
            b.iter(|| pool.install(|| largest_indices(&embeddings.cosines(black_box(&query)), 5)));
        });
    }
    group.finish();
}

criterion_group!(benches, bench_parsing, bench_deciding, bench_shortlist);
criterion_main!(benches);
