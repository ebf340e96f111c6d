//! Dependencies point one way: the layers of ARCHITECTURE.md, and no circle between files of a crate.
//!
//! Every path in the source is resolved through re-exports to the file that defines the item, so a `mod.rs` that only
//! declares and re-exports its children depends on none. Tests (`#[cfg(test)]`) do not count.

use super::*;

use syn::{Attribute, Item, UseTree, Visibility};

const CRATES: [(&str, &str); 15] = [
    ("slag_math", "common/math"),
    ("slag_common", "common"),
    ("slag_raster", "common/raster"),
    ("slag_locate", "common/locate"),
    ("slag_models", "common/models"),
    ("slag_service", "common/service"),
    ("slag_view", "common/view"),
    ("slag_encoder", "encoder"),
    ("slag_edge", "edge"),
    ("slag_lab", "encoder/lab"),
    ("slag_api", "common/api"),
    ("slag_robot", "doors/robot"),
    ("slag_mcap", "doors/mcap"),
    ("slag_mcp", "doors/mcp"),
    ("slag_ros", "doors/ros"),
];

/// A module's path, the crate's name first.
type ModulePath = Vec<String>;

#[derive(Default)]
struct Module {
    file: PathBuf,
    children: BTreeSet<String>,
    /// Names imported by `use`: the path as written, and whether other modules see it.
    imports: BTreeMap<String, ModulePath>,
    globs: Vec<ModulePath>,
    /// Paths used, without re-exports.
    paths: BTreeSet<ModulePath>,
}

struct Workspace(BTreeMap<ModulePath, Module>);

fn is_test(attributes: &[Attribute]) -> bool {
    let is_cfg_test =
        |a: &Attribute| a.path().is_ident("cfg") && a.parse_args::<syn::Ident>().is_ok_and(|i| i == "test");
    attributes.iter().any(is_cfg_test)
}

/// `#[path]`, `child.rs` or `child/mod.rs`.
fn file_of_child(parent: &Path, name: &str, attributes: &[Attribute]) -> PathBuf {
    let is_root = parent.file_name().is_some_and(|f| f == "mod.rs" || f == "lib.rs" || f == "main.rs");
    let folder = if is_root { parent.with_file_name("") } else { parent.with_extension("") };
    for attribute in attributes.iter().filter(|a| a.path().is_ident("path")) {
        if let syn::Meta::NameValue(value) = &attribute.meta
            && let syn::Expr::Lit(literal) = &value.value
            && let syn::Lit::Str(path) = &literal.lit
        {
            return parent.with_file_name(path.value());
        }
    }
    let flat = folder.join(format!("{name}.rs"));
    if flat.is_file() { flat } else { folder.join(name).join("mod.rs") }
}

impl Workspace {
    fn read() -> Self {
        let mut modules = Self(BTreeMap::new());
        for (name, folder) in CRATES {
            modules.read_module(vec![name.to_owned()], root().join(folder).join("src/lib.rs"));
        }
        modules
    }

    fn read_module(&mut self, path: ModulePath, file: PathBuf) {
        let text = fs_err::read_to_string(&file).expect("a source file");
        let source = syn::parse_file(&text).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
        self.read_items(path, file, &source.items);
    }

    fn read_items(&mut self, path: ModulePath, file: PathBuf, items: &[Item]) {
        let mut module = Module { file: file.clone(), ..Module::default() };
        let mut children = Vec::new();
        for item in items {
            match item {
                Item::Mod(child) if !is_test(&child.attrs) => {
                    // The first of two alternatives that a feature chooses is read.
                    if module.children.insert(child.ident.to_string()) {
                        children.push(child);
                    }
                }
                Item::Mod(_) => {}
                Item::Use(import) if !is_test(&import.attrs) => {
                    let is_public = !matches!(import.vis, Visibility::Inherited);
                    module.add_import(&import.tree, &mut Vec::new(), is_public);
                }
                Item::Use(_) => {}
                other => module.visit_item(other),
            }
        }
        self.0.insert(path.clone(), module);
        for child in children {
            let name = child.ident.to_string();
            let mut child_path = path.clone();
            child_path.push(name.clone());
            match &child.content {
                Some((_, items)) => self.read_items(child_path, file.clone(), items),
                None => self.read_module(child_path, file_of_child(&file, &name, &child.attrs)),
            }
        }
    }

    /// Module that defines a path's item, as seen from a module; `None` for foreign crates.
    fn resolve(&self, from: &ModulePath, path: &[String], depth: usize) -> Option<ModulePath> {
        if depth > 16 {
            return None;
        }
        let mut at: ModulePath;
        let mut rest = path;
        match path.first()?.as_str() {
            "crate" => {
                at = vec![from[0].clone()];
                rest = &rest[1..];
            }
            "self" => {
                at = from.clone();
                rest = &rest[1..];
            }
            "super" => {
                at = from.clone();
                while rest.first().is_some_and(|s| s == "super") {
                    at.pop();
                    rest = &rest[1..];
                }
            }
            name if CRATES.iter().any(|(known, _)| *known == name) => {
                at = vec![name.to_owned()];
                rest = &rest[1..];
            }
            name => {
                let module = self.0.get(from)?;
                if !module.children.contains(name) && !module.imports.contains_key(name) {
                    return None;
                }
                at = from.clone();
            }
        }
        while let Some(name) = rest.first() {
            let module = self.0.get(&at)?;
            if module.children.contains(name) {
                at.push(name.clone());
                rest = &rest[1..];
            } else if let Some(import) = module.imports.get(name) {
                // An import under its own name, such as a crate's, ends the search.
                if import.first() == Some(name) && import.len() == 1 {
                    return None;
                }
                let mut path = import.clone();
                path.extend(rest[1..].iter().cloned());
                return self.resolve(&at, &path, depth + 1);
            } else {
                break;
            }
        }
        self.0.contains_key(&at).then_some(at)
    }

    /// Pairs of (user, used) modules of different files, with the connecting path.
    fn edges(&self) -> Vec<(&ModulePath, ModulePath, String)> {
        let mut edges = Vec::new();
        for (from, module) in &self.0 {
            for path in module.paths.iter().chain(&module.globs) {
                if let Some(to) = self.resolve(from, path, 0)
                    && self.0[&to].file != module.file
                {
                    edges.push((from, to, path.join("::")));
                }
            }
        }
        edges
    }
}

impl Module {
    fn add_import(&mut self, tree: &UseTree, prefix: &mut ModulePath, is_public: bool) {
        match tree {
            UseTree::Path(path) => {
                prefix.push(path.ident.to_string());
                self.add_import(&path.tree, prefix, is_public);
                prefix.pop();
            }
            UseTree::Group(group) => {
                group.items.iter().for_each(|tree| self.add_import(tree, prefix, is_public))
            }
            UseTree::Glob(_) => self.globs.push(prefix.clone()),
            UseTree::Name(name) if name.ident == "self" => {
                let alias = prefix.last().expect("`self` follows a path").clone();
                self.import(alias, prefix.clone(), is_public);
            }
            UseTree::Name(name) => {
                let mut path = prefix.clone();
                path.push(name.ident.to_string());
                self.import(name.ident.to_string(), path, is_public);
            }
            UseTree::Rename(rename) => {
                let mut path = prefix.clone();
                if rename.ident != "self" {
                    path.push(rename.ident.to_string());
                }
                self.import(rename.rename.to_string(), path, is_public);
            }
        }
    }

    fn import(&mut self, name: String, path: ModulePath, is_public: bool) {
        if !is_public {
            self.paths.insert(path.clone());
        }
        self.imports.insert(name, path);
    }

    /// Arguments of macros and attributes are tokens; their paths are found by separators.
    fn visit_tokens(&mut self, tokens: &impl ToString) {
        let text = tokens.to_string().replace(" :: ", "::");
        for word in text.split(|c: char| !(c.is_alphanumeric() || c == '_' || c == ':')) {
            if word.contains("::") {
                self.paths.insert(word.split("::").filter(|s| !s.is_empty()).map(str::to_owned).collect());
            }
        }
    }
}

impl<'ast> Visit<'ast> for Module {
    fn visit_path(&mut self, path: &'ast syn::Path) {
        self.paths.insert(path.segments.iter().map(|segment| segment.ident.to_string()).collect());
        visit::visit_path(self, path);
    }

    /// The path of `pub(super)` names no item.
    fn visit_visibility(&mut self, _: &'ast Visibility) {}

    fn visit_item_fn(&mut self, item: &'ast syn::ItemFn) {
        if !is_test(&item.attrs) {
            visit::visit_item_fn(self, item);
        }
    }

    fn visit_item_impl(&mut self, item: &'ast syn::ItemImpl) {
        if !is_test(&item.attrs) {
            visit::visit_item_impl(self, item);
        }
    }

    fn visit_item_use(&mut self, item: &'ast syn::ItemUse) {
        self.add_import(&item.tree, &mut Vec::new(), false);
    }

    fn visit_macro(&mut self, item: &'ast syn::Macro) {
        self.visit_tokens(&item.tokens);
        visit::visit_macro(self, item);
    }

    fn visit_attribute(&mut self, attribute: &'ast Attribute) {
        if let syn::Meta::List(list) = &attribute.meta {
            self.visit_tokens(&list.tokens);
        }
    }
}

/// The layers in ARCHITECTURE.md: modules of each crate, from the bottom up.
fn stated_layers() -> BTreeMap<String, Vec<Vec<String>>> {
    let text = fs_err::read_to_string(root().join("ARCHITECTURE.md")).expect("ARCHITECTURE.md");
    let block = text.split("```layers\n").nth(1).unwrap().split("```").next().unwrap();
    let mut layers: BTreeMap<String, Vec<Vec<String>>> = BTreeMap::new();
    for line in block.lines().filter(|line| !line.trim().is_empty()) {
        let (name, rest) = line.split_once(':').unwrap_or_else(|| panic!("{line:?}: NAME: layer < layer"));
        let parts =
            rest.split('<').map(|layer| layer.split_whitespace().map(str::to_owned).collect()).collect();
        layers.insert(name.trim().replace('-', "_"), parts);
    }
    layers
}

#[test]
fn modules_use_only_the_layers_below() {
    let workspace = Workspace::read();
    let layers = stated_layers();
    let mut wrong = Vec::new();
    let place = |of: &str, name: &str| {
        layers.get(of).and_then(|l| l.iter().position(|l| l.iter().any(|m| m == name)))
    };
    for (name, _) in CRATES {
        assert!(place("crates", &name.replace('_', "-")).is_some(), "{name} stands in no layer of `crates`");
    }
    for (from, to, path) in workspace.edges() {
        let (of, user, used) = match from[0] == to[0] {
            true if from.len() < 2 || to.len() < 2 || from[1] == to[1] => continue,
            true if !layers.contains_key(&from[0]) => continue,
            true => (from[0].clone(), from[1].clone(), to[1].clone()),
            false => ("crates".to_owned(), from[0].replace('_', "-"), to[0].replace('_', "-")),
        };
        match (place(&of, &user), place(&of, &used)) {
            (Some(above), Some(below)) if above > below => {}
            (Some(_), Some(_)) => wrong.push(format!("{} uses {} ({path})", from.join("::"), to.join("::"))),
            (None, _) => wrong.push(format!("{user} stands in no layer of {of}")),
            (_, None) => wrong.push(format!("{used} stands in no layer of {of}")),
        }
    }
    wrong.sort();
    wrong.dedup();
    assert!(wrong.is_empty(), "against ARCHITECTURE.md:\n{}", wrong.join("\n"));
}

#[test]
fn files_form_no_circle() {
    let workspace = Workspace::read();
    let mut uses: BTreeMap<&Path, BTreeMap<&Path, String>> = BTreeMap::new();
    let edges = workspace.edges();
    for (from, to, path) in &edges {
        let (user, used) = (&workspace.0[*from].file, &workspace.0[to].file);
        uses.entry(user).or_default().entry(used).or_insert_with(|| path.clone());
    }
    // Files reachable from each file; two that reach each other form a circle.
    let reach = |start: &Path| -> BTreeSet<&Path> {
        let mut seen = BTreeSet::new();
        let mut open: Vec<&Path> = uses.get(start).into_iter().flat_map(|m| m.keys().copied()).collect();
        while let Some(file) = open.pop() {
            if seen.insert(file) {
                open.extend(uses.get(file).into_iter().flat_map(|m| m.keys().copied()));
            }
        }
        seen
    };
    let reached: BTreeMap<&Path, BTreeSet<&Path>> = uses.keys().map(|file| (*file, reach(file))).collect();
    let in_circle = |a: &Path, b: &Path| {
        reached.get(a).is_some_and(|r| r.contains(b)) && reached.get(b).is_some_and(|r| r.contains(a))
    };
    let short = |file: &Path| file.strip_prefix(root()).unwrap_or(file).display().to_string();
    let wrong: Vec<String> = uses
        .iter()
        .flat_map(|(user, used)| used.iter().map(move |(used, path)| (*user, *used, path)))
        .filter(|(user, used, _)| in_circle(user, used))
        .map(|(user, used, path)| format!("{} -> {} ({path})", short(user), short(used)))
        .collect();
    assert!(wrong.is_empty(), "files in circles:\n{}", wrong.join("\n"));
}

/// No source file is too long to read at once; generated tables do not count.
#[test]
fn no_file_is_over_700_lines() {
    let files = [sources("rs"), sources("wgsl")].concat();
    assert!(files.len() > 500, "{}", files.len());
    let mut long = Vec::new();
    for path in files {
        let n_lines = fs_err::read_to_string(&path).expect("text").lines().count();
        if n_lines > 700 {
            long.push(format!("{}: {n_lines} lines", path.strip_prefix(root()).unwrap_or(&path).display()));
        }
    }
    assert!(long.is_empty(), "split these:\n{}", long.join("\n"));
}
