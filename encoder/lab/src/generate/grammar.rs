//! Objects as data: a text file per noun lists the parts of such things.
//!
//! ```text
//! # a chair looks along +y
//! words: chair, dining chair
//! is: furniture, something to sit on
//! found: room wall, room floor
//! paint seat: wood, plastic | any
//! paint frame: metal, wood | black, same
//! let w = 0.40..0.50
//! let h = 0.44..0.50
//! box seat: 0, 0, h | w, w, 0.04
//! cylinder frame: x*(w/2-0.03), y*(w/2-0.03), h/2 | 0.02, h | for x -1, 1 | for y -1, 1
//! ```
//!
//! - The file's name is the noun, `words` are its synonyms, `is` its kinds.
//! - `found: SCENE PLACE`: scenes are `room`, `yard`, `street`, `warehouse`; places are `floor` (free-standing), `wall`
//!   (its back to a wall or an edge), `hung` (on a wall), `on` (on another thing's top), `row` (beside its likes),
//!   `shell` (built by the scene).
//! - `paint NAME: MATERIALS | COLOURS`; the first paint gives the thing its main colour. `any` stands for all
//!   colours, `same` for the first paint.
//! - `let NAME = FROM..TO`, or `pick A, B, C`, or one expression. Metres; z points up, the ground is at 0.
//! - `box`, `ellipsoid`: centre | full sizes; `cylinder`: centre | radius, height; `cone`: centre | lower radius,
//!   upper radius, height. Then, in any order: `turn RX, RY, RZ` (degrees, about x, then y, then z), `for NAME A,
//!   B, C`, `if EXPRESSION` (the part exists where it is above 0).
//! - `top: z | w, d`: a surface for other things.

use std::sync::LazyLock;

use clap::ValueEnum;
use glam::{DAffine3, DQuat, DVec3, EulerRot};
use include_dir::{Dir, include_dir};

use super::expression::Expression;
use super::paint::{Colour, Material, Paint};
use slag_math::random::Xorshift;

use super::solid::{Part, Shape};

static OBJECTS: Dir<'_> = include_dir!("$CARGO_MANIFEST_DIR/src/generate/objects");

/// The nouns of the object files, sorted by name.
pub(crate) static NOUNS: LazyLock<Vec<Noun>> = LazyLock::new(|| {
    let mut files: Vec<_> = OBJECTS.files().collect();
    files.sort_by_key(|file| file.path());
    let noun = |file: &&include_dir::File<'_>| {
        let name = file.path().file_stem().unwrap_or_default().to_string_lossy().replace('_', " ");
        let noun = Noun::parse(name, file.contents_utf8().unwrap_or_default());
        noun.unwrap_or_else(|reason| panic!("{}:{reason}", file.path().display()))
    };
    files.iter().map(noun).collect()
});

/// Kind of a scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum SceneKind {
    /// Indoors, furnished.
    Room,
    /// Outdoors, grass and a fence.
    Yard,
    /// Outdoors, a road with pavements.
    Street,
    /// Indoors, rows of things alike.
    Warehouse,
}

impl SceneKind {
    pub(super) fn has_roof(self) -> bool {
        matches!(self, Self::Room | Self::Warehouse)
    }
}

/// Place of a thing in a scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Place {
    /// Anywhere on the ground.
    Floor,
    /// Its back to a wall or to the edge of the scene.
    Wall,
    /// On a wall.
    Hung,
    /// On the top of another thing.
    On,
    /// In a row, beside its likes.
    Row,
    /// Built by the scene: floors, walls.
    Shell,
}

/// Surface for other things on top of a thing, in the thing's frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Top {
    pub z_m: f64,
    /// Width along x and depth along y.
    pub size_m: [f64; 2],
}

/// A noun: the rules by which its things are made.
#[derive(Clone, Debug)]
pub struct Noun {
    pub name: String,
    pub words: Vec<String>,
    pub kinds: Vec<String>,
    pub found: Vec<(SceneKind, Place)>,
    paints: Vec<PaintRule>,
    variables: Vec<Choice>,
    parts: Vec<PartRule>,
    top: Option<[Expression; 3]>,
}

#[derive(Clone, Debug)]
struct PaintRule {
    name: String,
    materials: Vec<Material>,
    /// Empty if only the first paint's colour is allowed.
    colours: Vec<Colour>,
    or_same: bool,
}

#[derive(Clone, Debug)]
enum Choice {
    Between([Expression; 2]),
    OneOf(Vec<Expression>),
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum ShapeKind {
    Box,
    Ellipsoid,
    Cylinder,
    Cone,
}

#[derive(Clone, Debug)]
struct PartRule {
    kind: ShapeKind,
    paint: usize,
    centre: [Expression; 3],
    sizes: Vec<Expression>,
    turn_deg: Option<[Expression; 3]>,
    /// Variables, by index, and their values.
    loops: Vec<(usize, Vec<Expression>)>,
    condition: Option<Expression>,
}

#[derive(Clone, Debug, PartialEq)]
pub struct Object {
    /// In its own frame: z up, the ground at 0, the front along +y.
    pub parts: Vec<Part>,
    /// Main colour first.
    pub colours: Vec<Colour>,
    pub paint: Paint,
    pub top: Option<Top>,
}

fn list(text: &str) -> impl Iterator<Item = &str> {
    text.split(',').map(str::trim)
}

fn expressions(text: &str, names: &[String]) -> Result<Vec<Expression>, String> {
    list(text).map(|text| Expression::parse(text, names)).collect()
}

fn exactly<const N: usize>(text: &str, names: &[String]) -> Result<[Expression; N], String> {
    let found = expressions(text, names)?;
    let n = found.len();
    found.try_into().map_err(|_| format!("{n} values in `{text}`, expected {N}"))
}

impl Noun {
    fn parse(name: String, text: &str) -> Result<Self, String> {
        let mut noun = Self {
            name,
            words: Vec::new(),
            kinds: Vec::new(),
            found: Vec::new(),
            paints: Vec::new(),
            variables: Vec::new(),
            parts: Vec::new(),
            top: None,
        };
        let mut names = Vec::new();
        for (line, number) in text.lines().zip(1..) {
            let line = line.split('#').next().unwrap_or_default().trim();
            if !line.is_empty() {
                noun.line(line, &mut names).map_err(|reason| format!("{number}: {reason}"))?;
            }
        }
        match noun.paints.is_empty() || noun.found.is_empty() {
            false => Ok(noun),
            true => Err(format!("{}: the file ends without `paint` or `found`", text.lines().count())),
        }
    }

    fn line(&mut self, line: &str, names: &mut Vec<String>) -> Result<(), String> {
        if let Some(rest) = line.strip_prefix("let ") {
            let (name, value) = rest.split_once('=').ok_or("no `=`, expected `let NAME = VALUE`")?;
            let choice = if let Some(values) = value.trim().strip_prefix("pick ") {
                Choice::OneOf(expressions(values, names)?)
            } else if let Some((from, to)) = value.split_once("..") {
                Choice::Between([Expression::parse(from, names)?, Expression::parse(to, names)?])
            } else {
                Choice::OneOf(vec![Expression::parse(value, names)?])
            };
            names.push(name.trim().to_owned());
            self.variables.push(choice);
            return Ok(());
        }
        let (head, rest) = line.split_once(':').ok_or_else(|| format!("`{line}`, expected `WORD: ...`"))?;
        let rest = rest.trim();
        match head.split_whitespace().collect::<Vec<_>>()[..] {
            ["words"] => self.words = list(rest).filter(|w| *w != self.name).map(str::to_owned).collect(),
            ["is"] => self.kinds = list(rest).map(str::to_owned).collect(),
            ["found"] => {
                self.found = list(rest).map(found).collect::<Result<_, _>>()?;
            }
            ["paint", name] => {
                let (materials, colours) =
                    rest.split_once('|').ok_or("no `|`, expected MATERIALS | COLOURS")?;
                let materials = list(materials).map(known).collect::<Result<_, _>>()?;
                let mut rule =
                    PaintRule { name: name.to_owned(), materials, colours: Vec::new(), or_same: false };
                for colour in list(colours) {
                    match colour {
                        "any" => rule.colours.extend(Colour::value_variants()),
                        "same" if !self.paints.is_empty() => rule.or_same = true,
                        colour => rule.colours.push(known(colour)?),
                    }
                }
                self.paints.push(rule);
            }
            ["top"] => {
                let (z, size) = rest.split_once('|').ok_or("no `|`, expected z | width, depth")?;
                let [w, d] = exactly(size, names)?;
                self.top = Some([Expression::parse(z, names)?, w, d]);
            }
            [kind, paint] => {
                let part = self.part(kind, paint, rest, names)?;
                self.parts.push(part);
            }
            _ => return Err(format!("`{head}`, expected words, is, found, paint, let, top or a shape")),
        }
        Ok(())
    }

    fn part(&self, kind: &str, paint: &str, rest: &str, names: &mut Vec<String>) -> Result<PartRule, String> {
        let (kind, n_sizes) = match kind {
            "box" => (ShapeKind::Box, 3),
            "ellipsoid" => (ShapeKind::Ellipsoid, 3),
            "cylinder" => (ShapeKind::Cylinder, 2),
            "cone" => (ShapeKind::Cone, 3),
            _ => return Err(format!("`{kind}`, expected box, ellipsoid, cylinder or cone")),
        };
        let paint = self
            .paints
            .iter()
            .position(|rule| rule.name == paint)
            .ok_or_else(|| format!("no paint `{paint}` above, expected the name of one"))?;
        let mut fields = rest.split('|').map(str::trim);
        let (Some(centre), Some(sizes)) = (fields.next(), fields.next()) else {
            return Err("no `|`, expected centre | sizes".into());
        };
        // Loop variables are valid in their line only.
        let n_names = names.len();
        let modifiers: Vec<&str> = fields.collect();
        let mut loops = Vec::new();
        for modifier in modifiers.iter().filter_map(|m| m.strip_prefix("for ")) {
            let (name, values) =
                modifier.trim().split_once(' ').ok_or("no values, expected `for NAME A, B, C`")?;
            let values = expressions(values, names)?;
            names.push(name.to_owned());
            loops.push((names.len() - 1, values));
        }
        let part = (|| {
            let mut turn_deg = None;
            let mut condition = None;
            for modifier in modifiers.iter().filter(|m| !m.starts_with("for ")) {
                match modifier.split_once(' ') {
                    Some(("turn", angles)) => turn_deg = Some(exactly(angles, names)?),
                    Some(("if", expression)) => condition = Some(Expression::parse(expression, names)?),
                    _ => return Err(format!("`{modifier}`, expected turn, for or if")),
                }
            }
            let found = expressions(sizes, names)?;
            if found.len() != n_sizes {
                return Err(format!("{} sizes in `{sizes}`, expected {n_sizes}", found.len()));
            }
            let centre = exactly(centre, names)?;
            Ok(PartRule { kind, paint, centre, sizes: found, turn_deg, loops, condition })
        })();
        names.truncate(n_names);
        part
    }

    pub fn colours(&self) -> &[Colour] {
        &self.paints[0].colours
    }

    pub fn materials(&self) -> &[Material] {
        &self.paints[0].materials
    }

    /// Makes a thing. Its main colour is an `allowed` one, unless the noun has none of these.
    pub fn make(&self, random: &mut Xorshift, allowed: impl Fn(Colour) -> bool) -> Object {
        let mut variables: Vec<f64> = Vec::new();
        for choice in &self.variables {
            let value = match choice {
                Choice::Between([from, to]) => {
                    let (from, to) = (from.value(&variables, random), to.value(&variables, random));
                    from + (to - from) * random.unit()
                }
                Choice::OneOf(values) => random.pick(values).value(&variables, random),
            };
            variables.push(value);
        }
        let mut paints: Vec<(Paint, Colour)> = Vec::new();
        for rule in &self.paints {
            let n = rule.colours.len() + usize::from(rule.or_same);
            let same = rule.or_same && random.below(n.max(1)) == 0;
            let paint = match paints.first() {
                Some(first) if same || rule.colours.is_empty() => *first,
                first => {
                    let possible: Vec<Colour> = match first {
                        None => rule.colours.iter().copied().filter(|c| allowed(*c)).collect(),
                        Some(_) => rule.colours.clone(),
                    };
                    let possible = if possible.is_empty() { &rule.colours } else { &possible };
                    let colour = *random.pick(possible);
                    let material = *random.pick(&rule.materials);
                    (Paint { rgb: colour.shade(random), material, seed: random.next_u32() }, colour)
                }
            };
            paints.push(paint);
        }
        let mut parts = Vec::new();
        for rule in &self.parts {
            rule.make(0, &mut variables, &paints, random, &mut parts);
        }
        let top = self.top.as_ref().map(|top| {
            let [z_m, w, d] = [0, 1, 2].map(|i| top[i].value(&variables, random));
            Top { z_m, size_m: [w, d] }
        });
        let mut colours: Vec<Colour> = Vec::new();
        for (_, colour) in &paints {
            if !colours.contains(colour) {
                colours.push(*colour);
            }
        }
        Object { parts, colours, paint: paints[0].0, top }
    }
}

fn found(text: &str) -> Result<(SceneKind, Place), String> {
    let (scene, place) = text.split_once(' ').ok_or_else(|| format!("`{text}`, expected SCENE PLACE"))?;
    Ok((known(scene)?, known(place.trim())?))
}

/// The value of this name.
fn known<T: ValueEnum>(name: &str) -> Result<T, String> {
    T::from_str(name, false).map_err(|_| {
        let names = T::value_variants().iter().filter_map(ValueEnum::to_possible_value);
        let names: Vec<String> = names.map(|value| value.get_name().to_owned()).collect();
        format!("`{name}`, expected one of: {}", names.join(", "))
    })
}

impl PartRule {
    fn make(
        &self,
        depth: usize,
        variables: &mut Vec<f64>,
        paints: &[(Paint, Colour)],
        random: &mut Xorshift,
        parts: &mut Vec<Part>,
    ) {
        if let Some((index, values)) = self.loops.get(depth) {
            for value in values {
                let value = value.value(variables, random);
                variables.truncate(*index);
                variables.push(value);
                self.make(depth + 1, variables, paints, random, parts);
            }
            variables.truncate(*index);
            return;
        }
        if self.condition.as_ref().is_some_and(|condition| condition.value(variables, random) <= 0.0) {
            return;
        }
        let mut vector = |expressions: &[Expression; 3]| {
            DVec3::from([0, 1, 2].map(|i| expressions[i].value(variables, random)))
        };
        let centre = vector(&self.centre);
        let turn = self.turn_deg.as_ref().map_or(DVec3::ZERO, &mut vector);
        // At least a millimetre thick.
        let sizes: Vec<f64> = self.sizes.iter().map(|s| s.value(variables, random).max(0.001)).collect();
        let shape = match self.kind {
            ShapeKind::Box => Shape::Box(DVec3::new(sizes[0], sizes[1], sizes[2]) / 2.0),
            ShapeKind::Ellipsoid => Shape::Ellipsoid(DVec3::new(sizes[0], sizes[1], sizes[2]) / 2.0),
            ShapeKind::Cylinder => Shape::Cone { radii_m: [sizes[0]; 2], half_height_m: sizes[1] / 2.0 },
            ShapeKind::Cone => Shape::Cone { radii_m: [sizes[0], sizes[1]], half_height_m: sizes[2] / 2.0 },
        };
        let turn = turn.map(f64::to_radians);
        let rotation = DQuat::from_euler(EulerRot::ZYX, turn.z, turn.y, turn.x);
        let object_from_part = DAffine3::from_rotation_translation(rotation, centre);
        parts.push(Part { shape, object_from_part, paint: paints[self.paint].0 });
    }
}

#[cfg(test)]
mod tests;
