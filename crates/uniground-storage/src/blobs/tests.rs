use super::*;

fn open_blobs(data: &tempfile::TempDir) -> Blobs {
    Blobs::open(Utf8Path::from_path(data.path()).unwrap(), &BlobHome::Folder, FileAccess::ReadWrite)
        .unwrap()
}

/// Nests thousands of folders, so that the full path is longer than the system allows.
#[test]
fn folders_of_any_depth_are_removed() {
    let data = tempfile::tempdir().unwrap();
    let blobs = open_blobs(&data);
    let mut top = blobs.tmp.join("0");
    fs::create_dir(&top).unwrap();
    for i in 1..3000 {
        // Move the inner folder into the next outer one: the path would be too long to create.
        let outer = blobs.tmp.join(i.to_string());
        fs::create_dir(&outer).unwrap();
        fs::rename(&top, outer.join("a name that is not short")).unwrap();
        top = outer;
    }
    let content = blobs.content("deep");
    fs::rename(&top, &content).unwrap();
    drop(blobs.move_to_tmp(&content).unwrap());
    assert!(!content.exists() && blobs.list_leftovers(Duration::ZERO).unwrap().is_empty());
}

#[test]
fn damage_is_reported_and_publishing_replaces_a_damaged_folder() {
    let data = tempfile::tempdir().unwrap();
    let blobs = open_blobs(&data);
    let publish = || {
        let scratch = blobs.scratch().unwrap();
        fs::create_dir(scratch.path().join("views")).unwrap();
        fs::write(scratch.path().join("cloud.ply"), "points").unwrap();
        fs::write(scratch.path().join("views/1.jpg"), "picture").unwrap();
        blobs.publish(scratch, &blobs.parse("p")).unwrap();
    };
    publish();
    let look = |closely| {
        let wrong = blobs.check_folder(&blobs.parse("p"), closely).unwrap();
        wrong.iter().map(|DamagedFile { file, what }| format!("{file} {what}")).collect::<Vec<_>>()
    };
    assert_eq!(look(CheckDepth::Bytes), [""; 0]);
    fs::write(blobs.parse("p").join("cloud.ply"), "pointz").unwrap();
    fs::remove_file(blobs.parse("p").join("views/1.jpg")).unwrap();
    fs::write(blobs.parse("p").join("note"), "x").unwrap();
    assert_eq!(look(CheckDepth::Names), ["views/1.jpg missing"]);
    assert_eq!(look(CheckDepth::Bytes), ["cloud.ply damaged", "views/1.jpg missing", "note stray"]);
    publish();
    assert_eq!(look(CheckDepth::Bytes), [""; 0]);
    assert_eq!(
        blobs.check_folder(&blobs.parse("q"), CheckDepth::Names).unwrap()[0].what,
        "missing"
    );
}

/// Creates a folder under `tmp/` with these files.
fn write_scratch(blobs: &Blobs, files: &[(&str, &str)]) -> Scratch {
    let scratch = blobs.scratch().unwrap();
    for (file, text) in files {
        let path = scratch.path().join(file);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }
    scratch
}

fn read(place: &Utf8Path, file: &str) -> String {
    fs::read_to_string(place.join(file)).unwrap_or_else(|error| format!("{file}: {error}"))
}

/// Returns the names under `tmp/`.
fn list_tmp(blobs: &Blobs) -> Vec<String> {
    let entries = blobs.tmp.read_dir_utf8().unwrap();
    entries.map(|entry| entry.unwrap().file_name().to_owned()).collect()
}

/// Waits until the background removal has finished.
async fn wait_until_tmp_is_empty(blobs: &Blobs) {
    for _ in 0..2000 {
        if list_tmp(blobs).is_empty() {
            return;
        }
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    panic!("not removed: {:?}", list_tmp(blobs));
}

/// Opens the same folders read-only.
fn open_read_only_blobs(data: &tempfile::TempDir) -> Blobs {
    Blobs::open_read_only(Utf8Path::from_path(data.path()).unwrap()).unwrap()
}

#[test]
fn folder_paths_follow_their_kind() {
    let data = tempfile::tempdir().unwrap();
    let (blobs, root) = (open_blobs(&data), Utf8Path::from_path(data.path()).unwrap());
    assert_eq!(blobs.content("h"), root.join("blobs/contents/h"));
    assert_eq!(blobs.parse("p"), root.join("blobs/parses/p"));
    assert_eq!(blobs.checkpoints("h"), root.join("blobs/checkpoints/h"));
    assert_eq!(blobs.answer("a"), root.join("blobs/answers/a"));
    assert_eq!(blobs.folder_path("parses", "p"), blobs.parse("p"));
    assert_eq!(blobs.tmp(), root.join("tmp"));
    for kind in KINDS {
        assert!(blobs.folder_path(kind, "").is_dir(), "{kind}");
    }
    assert!(blobs.is_content(&blobs.content("h")));
    for other in [blobs.parse("h"), blobs.content("h").join("views"), root.join("blobs/contents")] {
        assert!(!blobs.is_content(&other), "{other}");
    }
    assert!(blobs.is_writable() && !open_read_only_blobs(&data).is_writable());
}

#[test]
fn a_scratch_folder_is_removed_on_drop() {
    let data = tempfile::tempdir().unwrap();
    let blobs = open_blobs(&data);
    let (scratch, other) =
        (write_scratch(&blobs, &[("views/1.jpg", "picture")]), blobs.scratch().unwrap());
    assert_eq!(scratch.path().parent(), Some(blobs.tmp()));
    assert_ne!(scratch.path(), other.path());
    assert!(other.path().is_dir() && list_tmp(&blobs).len() == 2);
    drop(scratch);
    assert_eq!(list_tmp(&blobs), [other.path().file_name().unwrap()]);
}

#[test]
fn a_prepared_folder_is_visible_only_after_publishing() {
    let data = tempfile::tempdir().unwrap();
    let blobs = open_blobs(&data);
    let place = blobs.content("h");
    let scratch = write_scratch(&blobs, &[("cloud.ply", "points"), ("views/1.jpg", "picture")]);
    let path = scratch.path().to_owned();
    let prepared = blobs.prepare(scratch, &place).unwrap();
    assert!(!place.exists() && path.join("cloud.ply").exists());
    let sums = read(&path, checksums::SUMS);
    let files: Vec<&str> = sums.lines().filter_map(|line| line.split("  ").nth(1)).collect();
    assert_eq!(files, ["cloud.ply", "views/1.jpg"], "{sums}");
    blobs.publish_prepared(prepared).unwrap();
    assert_eq!(read(&place, "cloud.ply"), "points");
    assert_eq!(read(&place, "views/1.jpg"), "picture");
    assert_eq!(read(&place, checksums::SUMS), sums);
    assert!(!path.exists(), "the scratch folder was moved");
    assert_eq!(blobs.check_folder(&place, CheckDepth::Bytes).unwrap(), []);
    assert_eq!(list_tmp(&blobs), [""; 0]);
}

#[test]
fn an_unpublished_prepared_folder_is_removed() {
    let data = tempfile::tempdir().unwrap();
    let blobs = open_blobs(&data);
    let place = blobs.content("h");
    drop(blobs.prepare(write_scratch(&blobs, &[("a", "1")]), &place).unwrap());
    assert!(!place.exists());
    assert_eq!(list_tmp(&blobs), [""; 0]);
}

#[test]
fn the_first_of_two_publishers_wins() {
    let data = tempfile::tempdir().unwrap();
    let blobs = open_blobs(&data);
    let place = blobs.parse("p");
    // Both are prepared before either is published.
    let [first, second] = ["first", "second"]
        .map(|text| blobs.prepare(write_scratch(&blobs, &[("a", text)]), &place).unwrap());
    blobs.publish_prepared(first).unwrap();
    blobs.publish_prepared(second).unwrap();
    assert_eq!(read(&place, "a"), "first");
    blobs.publish(write_scratch(&blobs, &[("a", "third")]), &place).unwrap();
    assert_eq!(read(&place, "a"), "first");
    assert_eq!(list_tmp(&blobs), [""; 0], "the folders of the losers are removed");
}

#[test]
fn an_incomplete_folder_is_replaced_by_a_complete_one() {
    let data = tempfile::tempdir().unwrap();
    let blobs = open_blobs(&data);
    let place = blobs.parse("p");
    blobs.publish(write_scratch(&blobs, &[("a", "1"), ("b", "2")]), &place).unwrap();
    fs::remove_file(place.join("b")).unwrap();
    blobs.publish(write_scratch(&blobs, &[("a", "3")]), &place).unwrap();
    assert_eq!(read(&place, "a"), "3");
    assert!(!place.join("b").exists());
    assert_eq!(blobs.check_folder(&place, CheckDepth::Bytes).unwrap(), []);
    assert_eq!(list_tmp(&blobs), [""; 0]);
}

#[test]
fn files_with_known_checksums_are_not_read_again() {
    let data = tempfile::tempdir().unwrap();
    let blobs = open_blobs(&data);
    let place = blobs.content("h");
    // A wrong checksum is stored unchanged, which shows that the file was not read.
    let known = Sums::from([("a".into(), "0123".to_owned())]);
    blobs
        .publish_with_checksums(write_scratch(&blobs, &[("a", "1"), ("b", "2")]), &place, &known)
        .unwrap();
    assert!(read(&place, checksums::SUMS).starts_with("0123  a\n"));
    let damage = DamagedFile { file: "a".into(), what: "damaged".to_owned() };
    assert_eq!(blobs.check_folder(&place, CheckDepth::Bytes).unwrap(), [damage]);
}

#[test]
fn a_failed_publish_is_an_error_and_removes_the_folder() {
    let data = tempfile::tempdir().unwrap();
    let blobs = open_blobs(&data);
    let nowhere = blobs.root.join("no/such/kind");
    let error = blobs.publish(write_scratch(&blobs, &[("a", "1")]), &nowhere).unwrap_err();
    assert_eq!(error.kind(), io::ErrorKind::NotFound);
    assert_eq!(list_tmp(&blobs), [""; 0]);
}

#[test]
fn link_files_links_files_and_returns_their_checksums() {
    let data = tempfile::tempdir().unwrap();
    let blobs = open_blobs(&data);
    let place = blobs.content("h");
    blobs.publish(write_scratch(&blobs, &[("a", "1"), ("views/b", "2")]), &place).unwrap();
    let with = write_scratch(&blobs, &[("c", "3")]);
    let sums = blobs.link_files(&place, &with, "before".into()).unwrap();
    assert_eq!(read(with.path(), "before/a"), "1");
    assert_eq!(read(with.path(), "before/views/b"), "2");
    let expected = ["a", "views/b"].map(|file| {
        let sum = checksums::hash_file(&place.join(file)).unwrap();
        (Utf8Path::new("before").join(file), sum)
    });
    assert_eq!(sums, Sums::from(expected));
    let grown = blobs.content("i");
    blobs.publish_with_checksums(with, &grown, &sums).unwrap();
    assert_eq!(blobs.check_folder(&grown, CheckDepth::Bytes).unwrap(), []);
    assert_eq!(blobs.check_folder(&place, CheckDepth::Bytes).unwrap(), []);
}

#[tokio::test]
async fn discarded_folders_disappear_at_once_and_completely() {
    let data = tempfile::tempdir().unwrap();
    let blobs = open_blobs(&data);
    let (place, other) = (blobs.parse("p"), blobs.parse("q"));
    for place in [&place, &other] {
        blobs.publish(write_scratch(&blobs, &[("views/1.jpg", "picture")]), place).unwrap();
    }
    blobs.discard(place.clone()).await.unwrap();
    assert!(!place.exists());
    wait_until_tmp_is_empty(&blobs).await;
    blobs.discard(place).await.unwrap();
    assert!(other.join("views/1.jpg").exists(), "other folders are kept");
}

#[tokio::test]
async fn read_only_blobs_discard_nothing() {
    let data = tempfile::tempdir().unwrap();
    let blobs = open_blobs(&data);
    let place = blobs.parse("p");
    blobs.publish(write_scratch(&blobs, &[("a", "1")]), &place).unwrap();
    let looking = open_read_only_blobs(&data);
    looking.discard(place.clone()).await.unwrap();
    assert!(looking.set_aside(vec![place.clone()]).await.unwrap().is_empty());
    assert_eq!(read(&place, "a"), "1");
}

#[tokio::test]
async fn a_folder_set_aside_is_put_back_unless_replaced() {
    let data = tempfile::tempdir().unwrap();
    let blobs = open_blobs(&data);
    let (place, missing) = (blobs.parse("p"), blobs.parse("q"));
    blobs.publish(write_scratch(&blobs, &[("a", "old")]), &place).unwrap();
    let mut aside = blobs.set_aside(vec![missing, place.clone()]).await.unwrap();
    assert_eq!(aside.len(), 1, "a missing folder is skipped");
    assert!(!place.exists() && aside[0].path().starts_with(blobs.tmp()));
    blobs.put_back(aside.remove(0), place.clone()).await.unwrap();
    assert_eq!(read(&place, "a"), "old");
    assert_eq!(list_tmp(&blobs), [""; 0]);

    let mut aside = blobs.set_aside(vec![place.clone()]).await.unwrap();
    blobs.publish(write_scratch(&blobs, &[("a", "new")]), &place).unwrap();
    blobs.put_back(aside.remove(0), place.clone()).await.unwrap();
    assert_eq!(read(&place, "a"), "new");
    assert_eq!(list_tmp(&blobs), [""; 0], "the old folder is removed");

    let mut aside = blobs.set_aside(vec![place]).await.unwrap();
    let nowhere = blobs.root.join("no/such/kind");
    let error = blobs.put_back(aside.remove(0), nowhere).await.unwrap_err();
    assert_eq!(error.kind(), io::ErrorKind::NotFound);
}

#[tokio::test]
async fn remove_later_removes_folders_set_aside() {
    let data = tempfile::tempdir().unwrap();
    let blobs = open_blobs(&data);
    blobs.publish(write_scratch(&blobs, &[("a", "1")]), &blobs.parse("p")).unwrap();
    let aside = blobs.set_aside(vec![blobs.parse("p")]).await.unwrap();
    assert_eq!(list_tmp(&blobs).len(), 1);
    blobs.remove_later(aside);
    wait_until_tmp_is_empty(&blobs).await;
}

/// Spawning a task would panic here, outside of a Tokio runtime.
#[test]
fn remove_later_without_folders_spawns_no_task() {
    let data = tempfile::tempdir().unwrap();
    open_blobs(&data).remove_later(Vec::new());
}

#[test]
fn a_folder_that_cannot_be_moved_is_an_error() {
    let data = tempfile::tempdir().unwrap();
    let blobs = open_blobs(&data);
    assert!(blobs.move_to_tmp(&blobs.parse("p")).unwrap().is_none());
    fs::write(blobs.parse("file"), "x").unwrap();
    let below_a_file = blobs.parse("file").join("p");
    let error = blobs.move_to_tmp(&below_a_file).unwrap_err();
    assert_eq!(error.kind(), io::ErrorKind::NotADirectory);
}

#[test]
fn folders_are_listed_and_files_among_them_are_stray() {
    let data = tempfile::tempdir().unwrap();
    let blobs = open_blobs(&data);
    assert!(blobs.names("parses").unwrap().is_empty());
    for name in ["p", "q"] {
        fs::create_dir(blobs.parse(name)).unwrap();
    }
    fs::create_dir(blobs.answer("a")).unwrap();
    fs::write(blobs.parse("note"), "x").unwrap();
    fs::write(blobs.root.join("readme"), "x").unwrap();
    fs::write(blobs.root.join(home::CACHE_MARKER), "{}").unwrap();
    let mut names = blobs.names("parses").unwrap();
    names.sort();
    assert_eq!(names, ["p", "q"]);
    let mut orphan_folders = blobs.stray_files().unwrap();
    orphan_folders.sort();
    assert_eq!(orphan_folders, [blobs.parse("note"), blobs.root.join("readme")]);
}

#[test]
fn a_read_only_open_tolerates_missing_kinds() {
    let data = tempfile::tempdir().unwrap();
    let blobs = open_blobs(&data);
    fs::create_dir(blobs.answer("a")).unwrap();
    fs::remove_dir(blobs.folder_path("parses", "")).unwrap();
    let looking = open_read_only_blobs(&data);
    assert!(looking.names("parses").unwrap().is_empty());
    assert_eq!(looking.names("answers").unwrap(), ["a"]);
    // With write access, a missing kind is an error.
    assert_eq!(blobs.names("parses").unwrap_err().kind(), io::ErrorKind::NotFound);
}

#[test]
fn temporary_files_older_than_the_limit_are_leftovers() {
    let data = tempfile::tempdir().unwrap();
    let blobs = open_blobs(&data);
    let minute = Duration::from_mins(1);
    let age = |name: &str, at: std::time::SystemTime| {
        let file = fs::File::create(blobs.tmp.join(name)).unwrap();
        file.set_modified(at).unwrap();
    };
    let now = std::time::SystemTime::now();
    age("two hours old", now - minute * 120);
    age("half an hour old", now - minute * 30);
    age("from tomorrow", now + minute * 60 * 24);
    let left = |unchanged| {
        let left = blobs.list_leftovers(unchanged).unwrap();
        let mut names: Vec<String> =
            left.iter().map(|aside| aside.path().file_name().unwrap().to_owned()).collect();
        // Do not drop the results: that would remove the files.
        left.into_iter().for_each(std::mem::forget);
        names.sort();
        names
    };
    assert_eq!(left(minute * 60), ["two hours old"]);
    assert_eq!(left(minute * 10), ["half an hour old", "two hours old"]);
    assert_eq!(left(minute * 180), [""; 0]);
    assert_eq!(left(Duration::ZERO).len(), 3, "all files count without a minimum age");
    drop(blobs.list_leftovers(minute * 60).unwrap());
    assert_eq!(left(Duration::ZERO), ["from tomorrow", "half an hour old"]);
}

#[cfg(unix)]
#[test]
fn removing_a_link_keeps_its_target() {
    let data = tempfile::tempdir().unwrap();
    let blobs = open_blobs(&data);
    let kept = blobs.parse("kept");
    fs::create_dir(&kept).unwrap();
    fs::write(kept.join("a"), "1").unwrap();
    let folder = blobs.tmp.join("folder");
    fs::create_dir_all(folder.join("within")).unwrap();
    for link in [folder.join("within/link"), blobs.tmp.join("link")] {
        std::os::unix::fs::symlink(&kept, &link).unwrap();
    }
    let file = blobs.tmp.join("file");
    fs::write(&file, "x").unwrap();
    for gone in [&folder, &blobs.tmp.join("link"), &file, &blobs.tmp.join("nothing")] {
        remove_tree(gone, &blobs.tmp).unwrap();
    }
    assert_eq!(list_tmp(&blobs), [""; 0]);
    assert_eq!(read(&kept, "a"), "1");
    // A path below a file is an error.
    let below_a_file = kept.join("a/b");
    let error = remove_tree(&below_a_file, &blobs.tmp).unwrap_err();
    assert_eq!(error.kind(), io::ErrorKind::NotADirectory);
}
