//! Attacks by somebody who holds no key, or the keys of some roles.

use super::*;

use slag_common::tuf::MAX_ROOT_BYTES;

use super::repo::*;

#[test]
fn an_honest_repository_is_followed() {
    let mut repo = Repo::new();
    let mut kept = updated(&mut repo);
    repo.publish(b"two");
    let trusted = update(&mut kept, &mut repo).expect("an honest repository");
    let target = trusted.target(PATH).expect("listed");
    target.check(PATH, b"two").expect("the file");
    assert!(matches!(target.check(PATH, b"owt"), Err(TufError::Content { .. })), "another file");
    assert!(matches!(target.check(PATH, b"two "), Err(TufError::Content { .. })), "a longer file");
    assert_eq!(trusted.target("other"), None);
    // Nothing new: only the next root and the timestamp are requested.
    repo.reads.clear();
    update(&mut kept, &mut repo).expect("the same again");
    let names: Vec<&str> = repo.reads.iter().map(|(name, _)| name.as_str()).collect();
    assert_eq!(names, ["2.root.json", "timestamp.json"]);
}

/// Everything kept survives a round trip, except targets metadata, which is read again.
#[test]
fn what_is_kept_goes_round_as_json() {
    let mut repo = Repo::new();
    let kept = updated(&mut repo);
    let text = serde_json::to_vec(&kept).expect("JSON");
    let mut read = serde_json::from_slice::<Kept>(&text).expect("JSON");
    assert_eq!(read, Kept { targets: None, ..kept.clone() });
    update(&mut read, &mut repo).expect("honest");
    assert_eq!(read, kept);
}

#[test]
fn rollback_of_the_timestamp() {
    let mut repo = Repo::new();
    let old = repo.files["timestamp.json"].clone();
    repo.publish(b"two");
    let mut kept = updated(&mut repo);
    let before = kept.clone();
    repo.put("timestamp.json", old);
    let error = update(&mut kept, &mut repo).expect_err("an old timestamp");
    assert_eq!(error, TufError::Rollback { role: "timestamp".into(), seen: 2, offered: 1 });
    assert_eq!(kept, before);
}

/// With the timestamp key: an old snapshot under a new timestamp.
#[test]
fn rollback_of_the_snapshot() {
    let mut repo = Repo::new();
    let old = FileMeta::of(1, &repo.files["1.snapshot.json"]);
    repo.publish(b"two");
    let mut kept = updated(&mut repo);
    repo.sign_timestamp_as(9, old, NOW);
    let error = update(&mut kept, &mut repo).expect_err("an old snapshot");
    assert_eq!(error, TufError::Rollback { role: "snapshot".into(), seen: 2, offered: 1 });
}

/// With the keys of timestamp and snapshot: old or missing targets under a new snapshot.
#[test]
fn rollback_of_the_targets() {
    let mut repo = Repo::new();
    let old = FileMeta::of(1, &repo.files["1.targets.json"]);
    repo.publish(b"two");
    let kept = updated(&mut repo);
    repo.publish_snapshot(3, BTreeMap::from([("targets.json".to_owned(), old)]));
    let error = update(&mut kept.clone(), &mut repo).expect_err("old targets");
    assert_eq!(error, TufError::Rollback { role: "targets.json".into(), seen: 2, offered: 1 });
}

#[test]
fn a_role_that_vanishes_from_the_snapshot() {
    let mut repo = Repo::new();
    let targets = FileMeta::of(1, &repo.files["1.targets.json"]);
    let with = BTreeMap::from([
        ("targets.json".to_owned(), targets.clone()),
        ("other.json".to_owned(), FileMeta::of(1, b"")),
    ]);
    repo.publish_snapshot(2, with);
    let mut kept = updated(&mut repo);
    repo.publish_snapshot(3, BTreeMap::from([("targets.json".to_owned(), targets)]));
    let error = update(&mut kept, &mut repo).expect_err("other.json is gone");
    assert_eq!(error, TufError::Missing { what: "other.json".into() });
}

/// The same timestamp for ever is refused once any file has expired.
#[test]
fn freeze() {
    let mut repo = Repo::new();
    let kept = updated(&mut repo);
    let error = refresh(&mut kept.clone(), &mut repo, EXPIRES).expect_err("a frozen store");
    assert!(matches!(error, TufError::Expired { .. }), "{error}");
    refresh(&mut kept.clone(), &mut repo, EXPIRES - 1).expect("the last second");
    // Each role separately.
    for expired in ["timestamp", "snapshot", "targets"] {
        let mut repo = Repo::new();
        if expired == "targets" {
            repo.expires = NOW;
        }
        let targets = sign(2, repo.expires, &Targets::default(), &[&repo.owner.targets]);
        let meta = BTreeMap::from([("targets.json".to_owned(), FileMeta::of(2, &targets))]);
        repo.put("2.targets.json", targets);
        repo.expires = if expired == "snapshot" { NOW } else { EXPIRES };
        repo.publish_snapshot(2, meta);
        if expired == "timestamp" {
            repo.expires = NOW;
            repo.sign_timestamp();
        }
        if expired == "snapshot" {
            repo.expires = EXPIRES;
            repo.sign_timestamp();
        }
        let error = update(&mut client(&repo), &mut repo).expect_err(expired);
        assert!(matches!(error, TufError::Expired { .. }) && role_of(&error) == expired, "{error}");
    }
}

/// A clock at 1970 does not bring expired metadata back: the newest signed time counts.
#[test]
fn freeze_with_a_clock_that_was_set_back() {
    let mut repo = Repo::new();
    let mut late = repo.clone();
    late.expires = EXPIRES * 2;
    late.sign_timestamp_as(2, FileMeta::of(1, &late.files["1.snapshot.json"]), EXPIRES + 1);
    let mut kept = client(&repo);
    let error = refresh(&mut kept, &mut late, 0).unwrap_err();
    assert!(matches!(error, TufError::Expired { .. }) && role_of(&error) == "root", "{error}");
    // A refused timestamp does not move the clock of its client.
    let mut trusted = slag_common::tuf::Trusted::new(repo.root(), NOW).expect("a root");
    trusted.add_timestamp(&late.files["timestamp.json"]).expect_err("signed after the root's expiry");
    assert_eq!(trusted.now_unix_secs(), NOW);
    trusted.add_timestamp(&repo.files["timestamp.json"]).expect("the honest one");
    refresh(&mut kept, &mut repo, 0).expect("signed before it expired");
    assert_eq!(kept.signed_unix_secs(), Some(NOW));
}

#[test]
fn mix_and_match() {
    let mut repo = Repo::new();
    let first = repo.clone();
    repo.publish(b"two");
    for (name, other) in [("2.snapshot.json", "1.snapshot.json"), ("2.targets.json", "1.targets.json")] {
        let mut mixed = repo.clone();
        mixed.put(name, first.files[other].clone());
        let error = update(&mut client(&repo), &mut mixed).expect_err(name);
        assert!(matches!(error, TufError::Content { .. }), "{error}");
    }
    // The same without stated lengths and hashes, which the specification allows.
    let bare = |version| FileMeta { version, length: None, hashes: None };
    let mut mixed = repo.clone();
    mixed.sign_timestamp_as(3, bare(2), NOW);
    update(&mut client(&repo), &mut mixed).expect("an honest one");
    mixed.put("2.snapshot.json", first.files["1.snapshot.json"].clone());
    let error = update(&mut client(&repo), &mut mixed).expect_err("another snapshot");
    assert_eq!(error, TufError::Version { role: "snapshot".into(), expected: 2, found: 1 });
    let mut mixed = repo.clone();
    mixed.publish_snapshot(3, BTreeMap::from([("targets.json".to_owned(), bare(2))]));
    update(&mut client(&repo), &mut mixed).expect("an honest one");
    mixed.put("2.targets.json", first.files["1.targets.json"].clone());
    let error = update(&mut client(&repo), &mut mixed).expect_err("other targets");
    assert_eq!(error, TufError::Version { role: "targets".into(), expected: 2, found: 1 });
}

/// Every file longer than stated, or than the limit.
#[test]
fn endless_data() {
    let repo = Repo::new();
    for name in ["2.root.json", "timestamp.json", "1.snapshot.json", "1.targets.json"] {
        let mut endless = repo.clone();
        endless.put(name, vec![b' '; 6 << 20]);
        let error = update(&mut client(&repo), &mut endless).expect_err(name);
        assert!(matches!(&error, TufError::TooLong { what, .. } if what == name), "{error}");
        for (name, max_bytes) in &endless.reads {
            assert!(*max_bytes <= MAX_ROOT_BYTES, "{name}: {max_bytes} bytes are asked for");
        }
    }
    // Endless new roots.
    let mut endless = Repo::new();
    for _ in 0..300 {
        endless.rotate(endless.owner.clone());
    }
    let mut kept = client(&endless);
    let error = update(&mut kept, &mut endless).expect_err("300 roots");
    assert!(matches!(error, TufError::TooMany { .. }), "{error}");
    update(&mut kept, &mut endless).expect("the next update goes on");
}

#[test]
fn wrong_keys() {
    for role in ["targets", "snapshot", "timestamp"] {
        let mut repo = Repo::new();
        let trusted = client(&repo);
        match role {
            "targets" => repo.owner.targets = key(9),
            "snapshot" => repo.owner.snapshot = key(9),
            _ => repo.owner.timestamp = key(9),
        }
        repo.publish(b"evil");
        let error = update(&mut trusted.clone(), &mut repo).expect_err(role);
        assert_eq!(error, TufError::Signatures { role: role.into(), found: 0, threshold: 1 });
    }
}

/// One key cannot count twice, neither by signing twice nor under two ids.
#[test]
fn a_threshold_counts_keys() {
    let mut repo = Repo::new();
    let owner = Owner { root: vec![key(1)], root_threshold: 2, ..Owner::default() };
    assert!(matches!(
        Kept::from_root(&owner.sign_root(1, EXPIRES, &[])),
        Err(TufError::Signatures { found: 1, threshold: 2, .. })
    ));
    let mut body = owner.root_body();
    body.keys.insert("alias".into(), Key::of(&key(1)));
    body.roles.get_mut("root").expect("there").keyids.push("alias".into());
    let mut twice: serde_json::Value = serde_json::from_slice(&sign(1, EXPIRES, &body, &[&key(1)])).unwrap();
    let mut signature = twice["signatures"][0].clone();
    let signatures = twice["signatures"].as_array_mut().expect("a list");
    signature["keyid"] = "alias".into();
    signatures.push(signature);
    let error = Kept::from_root(twice.to_string().as_bytes()).expect_err("one key under two ids");
    assert_eq!(error, TufError::Signatures { role: "root".into(), found: 1, threshold: 2 });
    let mut again: serde_json::Value = serde_json::from_slice(&repo.files["timestamp.json"]).expect("JSON");
    let signature = again["signatures"][0].clone();
    again["signatures"].as_array_mut().expect("a list").push(signature);
    repo.put("timestamp.json", again.to_string().into_bytes());
    let error = update(&mut client(&repo), &mut repo).expect_err("signed twice");
    assert!(matches!(error, TufError::Format { .. }), "{error}");
}

/// Targets metadata instead of a snapshot, with one key for both roles.
#[test]
fn one_role_in_the_place_of_another() {
    let mut repo = Repo::new();
    repo.owner.snapshot = repo.owner.targets.clone();
    let root = repo.owner.sign_root(1, EXPIRES, &[]);
    let targets = repo.files["1.targets.json"].clone();
    repo.put("1.root.json", root);
    repo.sign_timestamp_as(2, FileMeta::of(1, &targets), NOW);
    repo.put("1.snapshot.json", targets);
    let error = update(&mut client(&repo), &mut repo).expect_err("targets as a snapshot");
    assert!(matches!(&error, TufError::Format { what, .. } if what.contains("_type")), "{error}");
}

/// Any flipped bit is refused, or leaves the content unchanged (case of hex digits, escapes).
#[test]
fn every_flipped_bit_is_refused() {
    let repo = Repo::new();
    let honest = update(&mut client(&repo), &mut repo.clone()).expect("honest");
    for name in ["timestamp.json", "1.snapshot.json", "1.targets.json"] {
        for bit in 0..repo.files[name].len() * 8 {
            let mut flipped = repo.clone();
            flipped.files.get_mut(name).expect("there")[bit / 8] ^= 1 << (bit % 8);
            if let Ok(found) = update(&mut client(&repo), &mut flipped) {
                let body = |t: &slag_common::tuf::Trusted| {
                    let timestamp = t.timestamp().expect("there").body.clone();
                    let snapshot: Snapshot = t.snapshot().expect("there").body.clone();
                    (timestamp, snapshot, t.targets().expect("there").body.clone())
                };
                assert_eq!(body(&found), body(&honest), "{name}, bit {bit}");
            }
        }
    }
}

/// Names what networks send instead of a store's files.
#[test]
fn pages_and_packed_files_are_named() {
    for (bytes, word) in [
        (&b"\n<html><body>Please log in.</body></html>"[..], "web page"),
        (b"\x1f\x8b\x08\x00", "gzip"),
        (b"Please log in.", "expected value"),
    ] {
        let error = Kept::from_root(bytes).expect_err("no metadata");
        assert!(matches!(&error, TufError::Format { what, .. } if what.contains(word)), "{error}");
    }
}
