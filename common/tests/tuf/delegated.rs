//! Delegated roles: a scene each, signed by keys that the targets role names.

use std::collections::BTreeMap;

use slag_common::tuf::{
    DelegatedRole, Delegations, FileMeta, Key, RoleKeys, TargetFile, Targets, TufError, find_target, sign,
};

use super::repo::*;

fn role(name: &str, signer: u8, pattern: &str, terminating: bool) -> DelegatedRole {
    let keys = RoleKeys { keyids: vec![Key::of(&key(signer)).id()], threshold: 1 };
    let paths = Some(vec![pattern.to_owned()]);
    DelegatedRole { name: name.into(), keys, terminating, paths, path_hash_prefixes: None }
}

fn targets(paths: &[&str], content: &[u8]) -> Targets {
    let targets = paths.iter().map(|path| ((*path).to_owned(), TargetFile::of(content))).collect();
    Targets { targets, delegations: None }
}

/// A repository that delegates: each role with its signer and the paths that it lists.
fn delegating(roles: Vec<DelegatedRole>, signed: &[(&str, u8, &[&str])]) -> Repo {
    let mut repo = Repo::new();
    let keys: BTreeMap<String, Key> = (40..50).map(|n| Key::of(&key(n))).map(|key| (key.id(), key)).collect();
    let top = Targets { targets: BTreeMap::new(), delegations: Some(Delegations { keys, roles }) };
    let bytes = sign(2, EXPIRES, &top, &[&repo.owner.targets]);
    let mut meta = BTreeMap::from([("targets.json".to_owned(), FileMeta::of(2, &bytes))]);
    repo.put("2.targets.json", bytes);
    for (name, signer, paths) in signed {
        let bytes = sign(1, EXPIRES, &targets(paths, name.as_bytes()), &[&key(*signer)]);
        meta.insert(format!("{name}.json"), FileMeta::of(1, &bytes));
        repo.put(&format!("1.{}.json", name.replace(' ', "%20")), bytes);
    }
    repo.publish_snapshot(2, meta);
    repo
}

/// Returns the name of the role that lists a path.
fn found(repo: &mut Repo, path: &str) -> Result<Option<String>, TufError> {
    let mut kept = client(repo);
    let mut trusted = update(&mut kept, repo)?;
    let target = find_target(&mut trusted, &mut kept, repo, path)?;
    let names = ["yard", "site two", "late"];
    Ok(target
        .map(|t| (*names.iter().find(|name| t.check(path, name.as_bytes()).is_ok()).expect("one")).into()))
}

#[test]
fn a_role_signs_for_its_paths_alone() {
    let roles = vec![role("yard", 40, "yard/*", false), role("site two", 41, "site/*", false)];
    let mut repo = delegating(
        roles,
        &[("yard", 40, &["yard/manifest", "site/stolen"]), ("site two", 41, &["site/manifest"])],
    );
    assert_eq!(found(&mut repo, "yard/manifest"), Ok(Some("yard".into())));
    assert_eq!(found(&mut repo, "site/manifest"), Ok(Some("site two".into())));
    assert_eq!(found(&mut repo, "site/stolen"), Ok(None), "yard does not sign for site/");
}

#[test]
fn a_role_needs_its_own_key() {
    let roles = vec![role("yard", 40, "yard/*", false), role("late", 41, "late/*", false)];
    let mut repo = delegating(roles, &[("yard", 41, &["yard/manifest"]), ("late", 41, &[])]);
    let error = found(&mut repo, "yard/manifest").expect_err("another role's key");
    assert_eq!(error, TufError::Signatures { role: "yard".into(), found: 0, threshold: 1 });
}

#[test]
fn a_terminating_role_has_the_last_word() {
    for terminating in [false, true] {
        let roles = vec![role("yard", 40, "a/*", terminating), role("late", 41, "a/*", false)];
        let mut repo = delegating(roles, &[("yard", 40, &["a/1"]), ("late", 41, &["a/1", "a/2"])]);
        assert_eq!(found(&mut repo, "a/1"), Ok(Some("yard".into())), "the first role counts");
        let second = (!terminating).then(|| "late".to_owned());
        assert_eq!(found(&mut repo, "a/2"), Ok(second), "terminating: {terminating}");
    }
}

/// SHA-256 of "a/1" begins with the prefix; oracle: `printf a/1 | sha256sum`.
#[test]
fn paths_by_the_beginning_of_their_hash() {
    for (prefix, expected) in [("", true), ("773232", true), ("0000", false)] {
        let mut by_hash = role("yard", 40, "", false);
        by_hash.paths = None;
        by_hash.path_hash_prefixes = Some(vec![prefix.to_owned()]);
        let mut repo = delegating(vec![by_hash], &[("yard", 40, &["a/1"])]);
        assert_eq!(found(&mut repo, "a/1"), Ok(expected.then(|| "yard".into())), "{prefix}");
    }
}

#[test]
fn delegations_without_an_end_are_cut_off() {
    let roles: Vec<DelegatedRole> = (0..40).map(|n| role(&format!("r{n}"), 40, "a/*", false)).collect();
    let names: Vec<String> = (0..40).map(|n| format!("r{n}")).collect();
    let signed: Vec<(&str, u8, &[&str])> = names.iter().map(|name| (name.as_str(), 40, &[][..])).collect();
    let error = found(&mut delegating(roles, &signed), "a/1").expect_err("40 roles");
    assert!(matches!(error, TufError::TooMany { .. }), "{error}");
}
