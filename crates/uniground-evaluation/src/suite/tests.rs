use super::*;
use uniground_geometry::{Point3, Vector3};

/// Creates a temporary folder with these files.
fn folder(files: &[(&str, &str)]) -> (tempfile::TempDir, Utf8PathBuf) {
    let temporary = tempfile::tempdir().unwrap();
    let root = Utf8PathBuf::from_path_buf(temporary.path().to_owned()).unwrap();
    for (name, text) in files {
        let file = root.join(name);
        fs::create_dir_all(file.parent().unwrap()).unwrap();
        fs::write(file, text).unwrap();
    }
    (temporary, root)
}

fn open(root: &Utf8Path, suite: &str) -> Suite {
    Suite::open(&root.join(suite), &SuiteOptions::default()).unwrap()
}

fn target(task: &Task) -> &Target {
    &task.truth.for_reader().target
}

fn omission_lines(suite: &Suite) -> Vec<String> {
    let relative = |o: &Omission| {
        format!("{}:{} {}", o.file.file_name().unwrap(), o.line.unwrap_or(0), o.reason)
    };
    suite.omissions.iter().map(relative).collect()
}

const ROOM: &str = r#"{"objects": [
    {"id": 0, "name": "chair", "min": [0, 0, 0], "max": [0.5, 0.5, 0.9]},
    {"id": 1, "name": "chair", "min": [2, 0, 0], "max": [2.5, 0.5, 0.9]},
    {"id": 2, "name": "table", "min": [0, 2, 0], "max": [1.5, 3, 0.7]}
]}"#;

#[test]
fn query_lists_are_joined_with_annotations_and_invalid_queries_are_reported() {
    let (_keep, root) = folder(&[
        ("room.scene.json", ROOM),
        (
            "room.queries.json",
            r#"[
 {"query": "the table", "target_id": 2, "kind": "unique"},
 {"query": "the piano", "target_id": null, "kind": "absent"},
 {"query": "the left chair", "target_id": 1, "id": "left"},
 {"query": "the right chair", "target_id": 0, "id": "left"},
 {"query": "the lamp", "target_id": 9},
 {"query": "  ", "target_id": 2},
 {"query": 7},
 {"query": "the red sofa", "targetid": 7},
 {"query": "a shelf", "target_box": {"center": [0, 0, 1], "size": [1, 0.3, 2]}},
 {"query": "a ghost", "target_box": {"center": [0, 0, 1], "size": [1, -1, 2]}}
]"#,
        ),
        ("other.queries.json", r#"[{"query": "the sofa", "target_id": 1}]"#),
    ]);
    let suite = Suite::open(&root, &SuiteOptions::default()).unwrap();
    assert_eq!(
        suite.tasks.iter().map(|t| t.id.as_str()).collect::<Vec<_>>(),
        ["room#1", "room#2", "left", "room#9"]
    );
    assert!(
        matches!(target(&suite.tasks[0]), Target::Object { name: Some(name), .. } if name == "table")
    );
    assert_eq!(target(&suite.tasks[1]), &Target::Absent);
    let uniqueness: Vec<_> = suite.tasks.iter().map(|t| t.truth.for_reader().uniqueness).collect();
    assert_eq!(uniqueness, ["unique", "absent", "multiple", "unknown"]);
    assert_eq!(suite.tasks[0].truth.for_reader().splits, ["kind: unique"]);
    let reported = omission_lines(&suite);
    assert!(reported[0].starts_with("room.queries.json:8 query: invalid type"), "{reported:?}");
    assert!(
        reported[1].starts_with("room.queries.json:9 target_id and target_box are missing"),
        "{reported:?}"
    );
    assert!(
        reported[2].starts_with("other.queries.json:1 the scene other is missing"),
        "{reported:?}"
    );
    assert!(
        reported[3].starts_with("room.queries.json:5 the id left is already used in"),
        "{reported:?}"
    );
    assert_eq!(reported[4], "room.queries.json:6 target 9 is not in the annotations of room");
    assert_eq!(reported[5], "room.queries.json:7 the query is empty");
    assert!(reported[6].starts_with("room.queries.json:11 the box has no volume"), "{reported:?}");
    assert_eq!(reported.len(), 7);
}

#[test]
fn suite_file_lists_its_own_scenes() {
    let (_keep, root) = folder(&[
        ("data/a.json", ROOM),
        (
            "suite.json",
            r#"{"format": "uniground-suite/1", "scenes": [{"id": "flat", "annotations": "data/a.json"}, {"id": "gone", "scan": "no.zip"}],
                "expressions": [{"scene": "flat", "query": "the table", "target_id": 2}, {"query": "nowhere", "target_id": 2}]}"#,
        ),
    ]);
    let suite = open(&root, "suite.json");
    assert_eq!((suite.tasks.len(), suite.scenes[0].id.as_str()), (1, "flat"));
    let reported = omission_lines(&suite);
    assert!(
        reported[0].contains("scene gone:") && reported[0].contains("does not exist"),
        "{reported:?}"
    );
    assert_eq!(reported[1], "suite.json:2 the expression has no scene");
}

#[test]
fn scanrefer_uniqueness_counts_only_objects_of_the_list() {
    let (_keep, root) = folder(&[
        ("scene0011_00.scene.json", ROOM),
        (
            "labels.tsv",
            "id\traw_category\tcategory\tcount\tnyu40id\teigen13id\tnyuClass\tnyu40class\n1\tchair\tchair\t1\t5\t9\tchair\tchair\n\
             2\tstool\tstool\t1\t5\t9\tstool\tchair\n3\ttable\ttable\t1\t7\t10\ttable\ttable\n",
        ),
        (
            "ScanRefer_filtered_val.json",
            r#"[{"scene_id": "scene0011_00", "object_id": "0", "object_name": "chair", "ann_id": "3", "description": "it is a chair.", "token": ["it"]},
                {"scene_id": "scene0011_00", "object_id": "1", "object_name": "stool", "ann_id": "0", "description": "it is a stool.", "token": []},
                {"scene_id": "scene0011_00", "object_id": "2", "object_name": "table", "ann_id": "0", "description": "it is a table.", "token": []},
                {"scene_id": "scene0011_00", "object_id": "x", "object_name": "table", "ann_id": "0", "description": "it is a table.", "token": []}]"#,
        ),
    ]);
    let uniqueness = |suite: &Suite| {
        suite.tasks.iter().map(|t| t.truth.for_reader().uniqueness).collect::<Vec<_>>()
    };
    let by_name = open(&root, "ScanRefer_filtered_val.json");
    assert_eq!(by_name.tasks[0].id, "scene0011_00-0-3");
    assert_eq!(uniqueness(&by_name), ["unique", "unique", "unique"]);
    assert_eq!(
        omission_lines(&by_name),
        ["ScanRefer_filtered_val.json:4 \"x\" is not an object's number"]
    );
    let options =
        SuiteOptions { label_map: Some(root.join("labels.tsv")), ..SuiteOptions::default() };
    let by_class = Suite::open(&root.join("ScanRefer_filtered_val.json"), &options).unwrap();
    assert_eq!(uniqueness(&by_class), ["multiple", "multiple", "unique"]);
}

#[test]
fn referit3d_splits_are_read_from_tables() {
    let (_keep, root) = folder(&[
        ("scene0515_00.scene.json", ROOM),
        (
            "nr3d.csv",
            "assignmentid,stimulus_id,utterance,correct_guess,scan_id,instance_type,target_id,tokens\n\
             7,scene0515_00-chair-2-1-0,\"The chair, on the LEFT.\",True,scene0515_00,chair,1,\"['the']\"\n\
             8,scene0515_00-chair-4-0-1-5-6,the chair near the table,True,scene0515_00,chair,0,[]\n\
             9,scene0515_00-chair-2-1-0,bad,True,scene0515_00,chair,one,[]\n",
        ),
        (
            "scanrefer_250.csv",
            "scan_id,target_id,utterance,instance_type,is_unique_scanrefer,is_easy_referit3d,is_vd_referit3d,pred_target_class\n\
             scene0515_00,2,the table,table,True,True,False,table\n",
        ),
    ]);
    let nr3d = open(&root, "nr3d.csv");
    let splits: Vec<_> = nr3d.tasks.iter().map(|t| t.truth.for_reader().splits.clone()).collect();
    assert_eq!(splits, [vec!["easy", "view-dependent"], vec!["hard", "view-independent"]]);
    assert_eq!(nr3d.tasks[0].id, "scene0515_00-1-7");
    assert_eq!(omission_lines(&nr3d), ["nr3d.csv:4 target_id \"one\" is not an object's number"]);
    let subset = open(&root, "scanrefer_250.csv");
    let truth = subset.tasks[0].truth.for_reader();
    assert_eq!(
        (truth.uniqueness, truth.splits.as_slice()),
        ("unique", &["easy".to_owned(), "view-independent".into()][..])
    );
    assert_eq!(subset.tasks[0].hints.for_reader().target_name.as_deref(), Some("table"));
}

#[test]
fn embodiedscan_scene_ids_are_the_last_path_component() {
    let (_keep, root) = folder(&[
        (
            "scans/47333462.json",
            r#"[{"bbox_id": 2, "target": "bed", "bbox_3d": [0, 0, 0.3, 2, 1.5, 0.6, 0.5, 0, 0]}]"#,
        ),
        (
            "vg.json",
            r#"[{"scan_id": "arkitscenes/Training/47333462", "target_id": 2, "distractor_ids": [], "text": "the bed on the left", "target": "bed"},
                {"scan_id": "arkitscenes/Training/47333462", "target_id": [1, 2], "distractor_ids": [], "text": "the beds", "target": "bed"},
                {"scan_id": "arkitscenes/Training/47333462", "text": "a test expression"}]"#,
        ),
        (
            "queries.json",
            r#"[{"scan_id": "47333462", "target_id": "2", "target_name": "bed", "caption": "the bed", "unique": false, "parsed_query": {}}]"#,
        ),
    ]);
    let options = SuiteOptions { scenes: Some(root.join("scans")), ..SuiteOptions::default() };
    let suite = Suite::open(&root.join("vg.json"), &options).unwrap();
    assert_eq!((suite.tasks.len(), suite.scenes[0].id.as_str()), (1, "47333462"));
    assert_eq!(suite.tasks[0].truth.for_reader().splits, ["view-dependent", "easy"]);
    assert!(matches!(target(&suite.tasks[0]), Target::Object { rotated: Some(_), .. }));
    assert!(omission_lines(&suite)[0].ends_with("2 targets: only expressions with one are scored"));
    let lists = Suite::open(&root.join("queries.json"), &options).unwrap();
    // The converter writes `false` for everything, so the annotations are counted instead.
    assert_eq!(lists.tasks[0].truth.for_reader().uniqueness, "unique");
}

#[test]
fn task_folders_are_converted_to_z_up() {
    let (_keep, root) = folder(&[
        (
            "scene0019_00/1/task.json",
            r#"{"scan_id": "scene0019_00", "target_id": "5", "target_name": "window", "caption": "a window above the dresser", "unique": true}"#,
        ),
        ("scene0019_00/1/gt.json", r#"{"target_id": null, "gt_bbox": [1, 0.5, -3, 2, 1, 4]}"#),
        (
            "scene0019_00/1/ref.json",
            r#"{"22": {"bbox": [1, 0.5, -3, 2, 1, 4], "similarity": 0.3}, "7": {"bbox": [0, 1, 0, 1, 1, 1]}}"#,
        ),
        ("scene0019_00/1/anchor_0.json", r#"{"anchor": "dresser", "bbox": [0, 0.5, 0, 1, 1, 2]}"#),
        ("scene0019_00/1/full_pcd.ply", "ply"),
        ("scene0019_00/2/task.json", r#"{"caption": "no truth"}"#),
    ]);
    let suite = Suite::open(&root, &SuiteOptions::default()).unwrap();
    let expected = Aabb { center: Point3::new(1.0, 3.0, 0.5), size: Vector3::new(2.0, 4.0, 1.0) };
    assert_eq!(
        target(&suite.tasks[0]),
        &Target::Object { name: Some("window".into()), aabb: expected, rotated: None }
    );
    let scene = &suite.scenes[0];
    assert_eq!(
        scene.recorded.as_ref().unwrap().objects.iter().map(|o| o.id).collect::<Vec<_>>(),
        [7, 22]
    );
    assert!(scene.scan.as_ref().unwrap().ends_with("full_pcd.ply"));
    let hints = suite.tasks[0].hints.for_reader();
    assert_eq!(
        (hints.target_name.as_deref(), hints.anchors[0].0.as_str()),
        (Some("window"), "dresser")
    );
    assert_eq!(hints.anchors[0].1.size, Vector3::new(1.0, 2.0, 1.0));
    assert!(suite.omissions[0].file.ends_with("2/gt.json"), "{:?}", suite.omissions);
}

#[test]
fn unscorable_suites_are_errors_with_a_reason() {
    let (_keep, root) = folder(&[
        ("empty.queries.json", "[]"),
        ("broken.queries.json", "[{\"query\": "),
        ("unknown.json", r#"[{"colour": "red"}]"#),
        ("columns.csv", "scan,utterance\na,b\n"),
        ("nothing/readme.txt", ""),
        ("missing.queries.json", r#"[{"query": "the table", "target_id": 1}]"#),
    ]);
    for (path, expected) in [
        ("empty.queries.json", "no expression to score (0 left out)"),
        ("broken.queries.json", "broken.queries.json:1: EOF while parsing"),
        ("unknown.json", "unknown kind of list"),
        ("columns.csv", "no column scan_id, target_id"),
        ("nothing", "no *.queries.json"),
        ("missing.queries.json", "the scene missing is missing: neither scan nor annotations"),
        ("absent", "no such file or folder"),
    ] {
        let error =
            format!("{:#}", Suite::open(&root.join(path), &SuiteOptions::default()).unwrap_err());
        assert!(error.contains(expected), "{path}: {error}");
    }
}

#[test]
fn sample_depends_only_on_ids_and_seed() {
    let expressions: String = (0..50)
        .map(|i| {
            format!("{}{{\"query\": \"q{i}\", \"target_id\": null}}", if i > 0 { "," } else { "" })
        })
        .collect();
    let (_keep, root) =
        folder(&[("room.scene.json", ROOM), ("room.queries.json", &format!("[{expressions}]"))]);
    let suite = open(&root, "room.queries.json");
    let ids = |suite: Suite| suite.tasks.into_iter().map(|t| t.id).collect::<Vec<_>>();
    let drawn = ids(suite.clone().sample(10, 1));
    assert_eq!(drawn.len(), 10);
    assert_eq!(ids(suite.clone().sample(10, 1)), drawn);
    assert_ne!(ids(suite.clone().sample(10, 2)), drawn);
    assert_eq!(ids(suite.clone().sample(500, 2)), ids(suite));
}

#[test]
fn sampling_by_scene_keeps_all_tasks_of_a_scene() {
    let names = ["a", "b", "c", "d", "e"];
    let annotations = names.map(|name| format!("{name}.scene.json"));
    let lists = names.map(|name| format!("{name}.queries.json"));
    let expressions =
        r#"[{"query": "one", "target_id": null}, {"query": "two", "target_id": null}]"#;
    let mut files: Vec<(&str, &str)> =
        annotations.iter().map(|name| (name.as_str(), ROOM)).collect();
    files.extend(lists.iter().map(|name| (name.as_str(), expressions)));
    let (_keep, root) = folder(&files);
    let suite = open(&root, "");
    let scenes = |seed| {
        let drawn = suite.clone().sample_by_scene(2, seed);
        assert_eq!(drawn.tasks.len(), 4, "both expressions of both scenes");
        drawn
            .tasks
            .iter()
            .map(|task| drawn.scenes[task.scene].id.clone())
            .collect::<std::collections::BTreeSet<_>>()
    };
    assert_eq!((scenes(1).len(), scenes(1)), (2, scenes(1)));
    assert!((0..20).any(|seed| scenes(seed) != scenes(1)));
}
