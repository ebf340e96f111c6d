//! Roots: who may name the next one, and what a new root repairs.

use super::*;

use super::repo::*;

fn others() -> Owner {
    Owner { root: vec![key(11), key(12), key(13)], ..Owner::default() }
}

#[test]
fn a_root_needs_the_old_keys_and_its_own() {
    let repo = Repo::new();
    let offer = |bytes: Vec<u8>, version: u64| {
        let mut offered = repo.clone();
        offered.put(&format!("{version}.root.json"), bytes);
        update(&mut client(&repo), &mut offered)
    };
    let old = Owner::default().root;
    offer(others().sign_root(2, EXPIRES, &old), 2).expect("old and new keys");
    offer(others().sign_root(2, EXPIRES, &old[1..]), 2).expect("a threshold of the old keys");
    let error = offer(others().sign_root(2, EXPIRES, &old[2..]), 2).expect_err("one old key");
    assert_eq!(error, TufError::Signatures { role: "root".into(), found: 1, threshold: 2 });
    let error = offer(others().sign_root(2, EXPIRES, &[]), 2).expect_err("new keys alone");
    assert_eq!(error, TufError::Signatures { role: "root".into(), found: 0, threshold: 2 });
    // The old keys only: the new root's own are missing.
    let silent = slag_common::tuf::sign(2, EXPIRES, &others().root_body(), &[&old[0], &old[1]]);
    let error = offer(silent, 2).expect_err("old keys alone");
    assert_eq!(error, TufError::Signatures { role: "root".into(), found: 0, threshold: 2 });
    for version in [1, 3] {
        let error = offer(others().sign_root(version, EXPIRES, &old), 2).expect_err("another version");
        assert_eq!(error, TufError::Version { role: "root".into(), expected: 2, found: version });
    }
}

/// Only the last root's expiry counts: a robot that was away for years follows the chain.
#[test]
fn expired_roots_lead_to_the_last_one() {
    let mut repo = Repo::new();
    let mut kept = client(&repo);
    repo.put("2.root.json", repo.owner.sign_root(2, NOW, &[]));
    let error = update(&mut kept.clone(), &mut repo).expect_err("the last root has expired");
    assert!(matches!(error, TufError::Expired { .. }) && role_of(&error) == "root", "{error}");
    repo.put("3.root.json", repo.owner.sign_root(3, EXPIRES, &[]));
    update(&mut kept, &mut repo).expect("a good root follows");
    assert!(kept.root.contains("\"version\":3"));
}

/// A new root counts even if nothing else arrives.
#[test]
fn a_new_root_is_kept_after_an_error() {
    let mut repo = Repo::new();
    let mut kept = updated(&mut repo);
    repo.rotate(others());
    repo.files.remove("timestamp.json");
    let error = update(&mut kept, &mut repo).expect_err("no timestamp");
    assert_eq!(error, TufError::Missing { what: "timestamp.json".into() });
    assert!(kept.root.contains("\"version\":2"));
    assert!(kept.timestamp.is_some(), "its keys have not changed");
}

/// A thief of the online keys signs the highest versions; honest metadata is a rollback until a root names new keys.
#[test]
fn fast_forward_is_made_good_by_a_new_root() {
    for taken in ["timestamp", "snapshot", "targets"] {
        let mut repo = Repo::new();
        let honest = repo.clone();
        let mut kept = updated(&mut repo);
        let top = u64::MAX - 1;
        match taken {
            "timestamp" => {
                repo.sign_timestamp_as(top, FileMeta::of(1, &repo.files["1.snapshot.json"]), NOW);
            }
            "snapshot" => {
                let meta = FileMeta::of(1, &repo.files["1.targets.json"]);
                repo.publish_snapshot(top, [("targets.json".to_owned(), meta)].into());
            }
            _ => repo.publish_again(b"evil", top, 2),
        }
        update(&mut kept, &mut repo).expect("valid signatures");
        let mut repo = honest.clone();
        repo.publish(b"two");
        repo.sign_timestamp();
        let error = update(&mut kept.clone(), &mut repo).expect_err(taken);
        assert!(matches!(error, TufError::Rollback { seen, .. } if seen == top), "{taken}: {error}");
        let next = Owner { targets: key(24), snapshot: key(25), timestamp: key(26), ..repo.owner.clone() };
        repo.rotate(next);
        repo.publish_again(b"two", 2, 2);
        let trusted = update(&mut kept, &mut repo).expect(taken);
        assert_eq!(trusted.targets().expect("there").head.version, 2, "{taken}");
    }
}

/// A signed time in the far future would expire everything; new timestamp keys revoke it.
#[test]
fn a_signed_time_in_the_future_is_made_good_by_a_new_root() {
    let mut repo = Repo::new();
    let mut kept = updated(&mut repo);
    let honest = repo.clone();
    repo.expires = u64::MAX / 2;
    repo.sign_timestamp_as(2, FileMeta::of(1, &repo.files["1.snapshot.json"]), EXPIRES - 1);
    update(&mut kept, &mut repo).expect("not yet expired");
    assert_eq!(kept.signed_unix_secs(), Some(EXPIRES - 1));
    let mut repo = honest;
    repo.rotate(Owner { timestamp: key(26), ..repo.owner.clone() });
    repo.publish(b"two");
    update(&mut kept, &mut repo).expect("a new key");
    assert_eq!(kept.signed_unix_secs(), Some(NOW));
}

/// Signatures by keys that a root has withdrawn are refused, even of metadata on board.
#[test]
fn a_withdrawn_key_is_refused() {
    let mut repo = Repo::new();
    let mut kept = updated(&mut repo);
    let thief = repo.owner.clone();
    repo.rotate(Owner { targets: key(24), ..thief.clone() });
    let mut evil = repo.clone();
    evil.owner.targets = thief.targets;
    evil.publish(b"evil");
    let error = update(&mut kept.clone(), &mut evil).expect_err("the old key");
    assert_eq!(error, TufError::Signatures { role: "targets".into(), found: 0, threshold: 1 });
    // Even what was accepted before is requested again.
    let error = update(&mut kept.clone(), &mut repo).expect_err("old targets");
    assert!(matches!(error, TufError::Signatures { .. }), "{error}");
    repo.publish(b"two");
    update(&mut kept, &mut repo).expect("the new key");
}

/// All online keys without the root: what they sign counts until a root withdraws them, but they cannot name keys.
#[test]
fn online_keys_cannot_name_keys() {
    let mut repo = Repo::new();
    let mut kept = updated(&mut repo);
    let thief = Owner { root: vec![key(31)], root_threshold: 1, ..repo.owner.clone() };
    let online = [repo.owner.targets.clone(), repo.owner.snapshot.clone(), repo.owner.timestamp.clone()];
    repo.put("2.root.json", thief.sign_root(2, EXPIRES, &online));
    let error = update(&mut kept, &mut repo).expect_err("a root by online keys");
    assert_eq!(error, TufError::Signatures { role: "root".into(), found: 0, threshold: 2 });
    // With a threshold of root keys, the thief owns the repository; only new trust by hand helps.
    repo.put("2.root.json", thief.sign_root(2, EXPIRES, &repo.owner.root[..2]));
    update(&mut kept, &mut repo).expect("root keys decide");
}

#[test]
fn roots_that_ask_for_nothing_are_refused() {
    let owner = Owner::default();
    let good = owner.root_body();
    let refused = |change: &dyn Fn(&mut slag_common::tuf::Root)| {
        let mut body = good.clone();
        change(&mut body);
        let signers: Vec<_> = owner.root.iter().collect();
        matches!(
            Kept::from_root(&slag_common::tuf::sign(1, EXPIRES, &body, &signers)),
            Err(TufError::Format { .. })
        )
    };
    assert!(!refused(&|_| {}));
    assert!(refused(&|root| root.roles.get_mut("timestamp").expect("there").threshold = 0));
    assert!(refused(&|root| drop(root.roles.remove("snapshot"))));
    assert!(refused(&|root| root.consistent_snapshot = false));
    assert!(refused(&|root| {
        let role = root.roles.get_mut("root").expect("there");
        role.keyids.push(role.keyids[0].clone());
    }));
}
