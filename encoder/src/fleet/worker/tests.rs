use super::*;

/// A folder lives as long as its worker; what a killed worker left goes with the next one, and nothing else does.
#[test]
fn folders_go_with_their_workers() {
    let dir = tempfile::tempdir().expect("a folder");
    let scratch = dir.path().join("scratch");
    let names = || {
        let entries = fs_err::read_dir(&scratch).expect("reads");
        let mut names: Vec<_> = entries.map(|entry| entry.expect("reads").path()).collect();
        names.sort();
        names
    };
    let first = RunFolder::make(&scratch).expect("made");
    fs_err::create_dir_all(first.path().join("photos")).expect("made");
    fs_err::write(first.path().join("photos/a.png"), "a").expect("written");
    // As a killed worker leaves it, and as neighbours have theirs.
    let left = scratch.join("slag-worker-left-1");
    fs_err::create_dir_all(left.join("photos")).expect("made");
    fs_err::write(left.join(LOCK), "").expect("written");
    let foreign = [scratch.join("photos"), scratch.join("slag-worker-without-a-lock")];
    foreign.iter().for_each(|path| fs_err::create_dir_all(path).expect("made"));

    let second = RunFolder::make(&scratch).expect("made");
    assert_ne!(first.path(), second.path());
    let mut expected = vec![first.path().to_owned(), second.path().to_owned()];
    expected.extend(foreign.clone());
    expected.sort();
    assert_eq!(names(), expected);
    drop((first, second));
    assert_eq!(names(), foreign);
}
