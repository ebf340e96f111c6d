//! The definition of objects, set by set.

use std::collections::{BTreeSet, HashSet};

use super::*;

/// By view: the masks of each Gaussian that it sees; masks numbered within the view.
type Views = Vec<BTreeMap<u32, BTreeSet<u32>>>;

/// Things of [`made_views`]: rows of Gaussians in superpoints of ten.
const N_THINGS: u32 = 6;
const PER_ROW: u32 = 40;
const PER_SUPERPOINT: u32 = 10;
/// Masks per view: one a thing, two for parts, one of everything.
const N_MASKS: u32 = N_THINGS + 3;

/// Eight views of six things see seven in ten Gaussians. View 2 has one mask for things 0, 1 and 3, view 5 three for
/// thing 2; half of the views have one for everything.
fn made_views(random: &mut Random) -> Views {
    let view = |view: u32| {
        let mut of_view = BTreeMap::new();
        for gaussian in 0..PER_ROW * N_THINGS {
            if random.below(10) >= 7 {
                continue;
            }
            let thing = gaussian / PER_ROW;
            let own = match (view, thing) {
                (2, 0 | 1 | 3) => 0,
                (5, 2) => [2, N_THINGS, N_THINGS + 1][gaussian as usize % 3],
                _ => thing,
            };
            // Ragged: one in twenty has another thing's mask, one in ten none.
            let own = if random.below(20) == 0 { random.below(u64::from(N_THINGS)) as u32 } else { own };
            let masks = [
                Some(own).filter(|_| random.below(10) > 0),
                Some(N_MASKS - 1).filter(|_| view.is_multiple_of(2)),
            ];
            let masks: BTreeSet<u32> = masks.into_iter().flatten().collect();
            if !masks.is_empty() {
                of_view.insert(gaussian, masks);
            }
        }
        of_view
    };
    (0..8).map(view).collect()
}

/// Meaningless views: few, with masks of blocks and of chance.
fn random_views(random: &mut Random) -> Views {
    let n_views = 1 + random.below(5);
    let view = |_| {
        let n_masks = 1 + random.below(4);
        let seen: Vec<u32> = (0..PER_ROW * N_THINGS).filter(|_| random.below(3) > 0).collect();
        let masks = |gaussian: u32, random: &mut Random| {
            let of_block = u64::from(gaussian / 25) % n_masks;
            let other = if random.below(4) == 0 { random.below(n_masks) } else { of_block };
            BTreeSet::from([of_block as u32, other as u32])
        };
        seen.into_iter().map(|gaussian| (gaussian, masks(gaussian, random))).collect()
    };
    (0..n_views).map(view).collect()
}

/// The definition, set by set: each superpoint's object, numbered by first superpoints, and each object's masks.
fn oracle(
    views: &Views,
    pairs: &[(u32, u32)],
    superpoint_of: &[u32],
    uncut: impl Fn(usize, u32) -> f64,
) -> (Vec<Option<usize>>, Vec<usize>) {
    type Set = BTreeSet<u32>;
    let n = superpoint_of.iter().max().map_or(0, |last| *last as usize + 1);
    let gaussians = |superpoints: &[usize]| -> Set {
        let is_in = |i: &u32| superpoints.contains(&(superpoint_of[*i as usize] as usize));
        (0..superpoint_of.len() as u32).filter(is_in).collect()
    };
    let masks: Vec<BTreeMap<u32, Set>> = views
        .iter()
        .map(|view| {
            let mut masks = BTreeMap::<u32, Set>::new();
            for (gaussian, of_gaussian) in view {
                of_gaussian.iter().for_each(|mask| _ = masks.entry(*mask).or_default().insert(*gaussian));
            }
            masks
        })
        .collect();
    let seen = |view: usize, set: &Set| -> Set {
        set.iter().copied().filter(|gaussian| views[view].contains_key(gaussian)).collect()
    };
    let mut evidence: BTreeMap<(usize, usize), (u64, u64)> = BTreeMap::new();
    for (a, b) in pairs {
        let (mut together, mut all) = (0, 0);
        for (view, masks) in masks.iter().enumerate() {
            let [a, b] = [a, b].map(|of| seen(view, &gaussians(&[*of as usize])));
            let shows = |of: &Set| -> HashSet<u32> {
                let is_inside = |mask: &Set| 2 * mask.intersection(of).count() >= of.len();
                masks.iter().filter(|(_, mask)| is_inside(mask)).map(|(mask, _)| *mask).collect()
            };
            if a.is_empty() || b.is_empty() || (shows(&a).is_empty() && shows(&b).is_empty()) {
                continue;
            }
            let (both, either) =
                (shows(&a).intersection(&shows(&b)).count(), shows(&a).union(&shows(&b)).count());
            let weight = a.len().min(b.len()) as u64;
            together += weight * ((both << 20) / either) as u64;
            all += weight;
        }
        if together > 0 {
            evidence.insert((*a as usize, *b as usize), (together, all));
        }
    }
    // Sets of superpoints, joined pair by pair; every sum is made anew. A set goes by one of its superpoints.
    let mut sets: Vec<Vec<usize>> = (0..n).map(|superpoint| vec![superpoint]).collect();
    let mut named: BTreeMap<usize, usize> = (0..n).map(|set| (set, set)).collect();
    let mut parts: BTreeMap<usize, [usize; 2]> = BTreeMap::new();
    loop {
        let between = |a: usize, b: usize| {
            let of_sets = evidence.iter().filter(|((x, y), _)| {
                let [a, b] = [a, b].map(|set| &sets[set]);
                (a.contains(x) && b.contains(y)) || (a.contains(y) && b.contains(x))
            });
            of_sets.fold((0, 0), |sum, (_, (together, all))| (sum.0 + together, sum.1 + all))
        };
        let mut best: Option<(f64, usize, usize)> = None;
        for (a, set_a) in &named {
            for (b, set_b) in named.range(a + 1..) {
                let (together, all) = between(*set_a, *set_b);
                let affinity = (together as f64 / f64::from(1 << 20) + 0.3) / (all as f64 + 1.0);
                if together > 0 && best.is_none_or(|(most, ..)| affinity > most) {
                    best = Some((affinity, *a, *b));
                }
            }
        }
        let Some((_, a, b)) = best else { break };
        let n_near =
            |set: usize| named.values().filter(|other| **other != set && between(set, **other).0 > 0).count();
        let [set_a, set_b] = [named[&a], named[&b]];
        let (kept, gone) = if n_near(set_b) > n_near(set_a) { (b, a) } else { (a, b) };
        parts.insert(sets.len(), [set_a, set_b]);
        named.remove(&gone);
        named.insert(kept, sets.len());
        sets.push([&sets[set_a][..], &sets[set_b][..]].concat());
    }
    let alive: Vec<usize> = named.into_values().collect();
    let iou = |view: usize, mask: &Set, set: &Set| {
        let of_view = seen(view, set);
        mask.intersection(&of_view).count() as f64 / mask.union(&of_view).count() as f64
    };
    let worth = |set: &Set| {
        let (mut agreements, mut n_whole) = (Vec::<(f64, f64)>::new(), 0.0);
        for (view, masks) in masks.iter().enumerate() {
            let n_seen = seen(view, set).len();
            if n_seen == 0 || 10 * n_seen < set.len() {
                continue;
            }
            let ious = masks.iter().map(|(mask, of)| (iou(view, of, set), uncut(view, *mask)));
            let (best, uncut) = ious.fold((0.0, 1.0), |best, of| if of.0 > best.0 { of } else { best });
            agreements.push((best, uncut.max(0.05).powi(2)));
            n_whole += if best > 0.5 { ((uncut - 0.75) / 0.15).clamp(0.0, 1.0) } else { 0.0 };
        }
        let weights: f64 = agreements.iter().map(|(_, weight)| weight).sum();
        let consensus = agreements.iter().map(|(best, weight)| best * weight).sum::<f64>() / weights;
        let is_thing =
            set.len() >= 10 && n_whole > 0.0 && 11.0 * n_whole >= agreements.len() as f64 && consensus >= 0.3;
        if is_thing { consensus.powi(8) * (set.len() as f64).powf(0.25) } else { 0.0 }
    };
    let worths: Vec<f64> = sets.iter().map(|set| worth(&gaussians(set))).collect();
    fn choose(set: usize, worths: &[f64], parts: &BTreeMap<usize, [usize; 2]>) -> (f64, Vec<usize>) {
        let of_parts = parts.get(&set).map(|parts_of| parts_of.map(|part| choose(part, worths, parts)));
        let (sum, chosen) =
            of_parts.map_or((0.0, Vec::new()), |[(a, of_a), (b, of_b)]| (a + b, [of_a, of_b].concat()));
        if worths[set] > 0.0 && worths[set] >= sum { (worths[set], vec![set]) } else { (sum, chosen) }
    }
    let mut chosen: Vec<usize> = alive.iter().flat_map(|root| choose(*root, &worths, &parts).1).collect();
    chosen.sort_by_key(|set| sets[*set].iter().min().copied());
    let object_of = |superpoint| chosen.iter().position(|set| sets[*set].contains(&superpoint));
    let n_masks = |set: &usize| {
        let set = gaussians(&sets[*set]);
        let of_view = |(view, masks): (usize, &BTreeMap<u32, Set>)| {
            masks.values().filter(|mask| iou(view, mask, &set) > 0.5).count()
        };
        masks.iter().enumerate().map(of_view).sum()
    };
    ((0..n).map(object_of).collect(), chosen.iter().map(n_masks).collect())
}

/// Oracle: sets and float64.
#[test]
fn objects_are_those_of_the_definition() {
    let mut n_objects = 0;
    for seed in 0..16 {
        let mut random = Random::new(seed);
        for views in [made_views(&mut random), random_views(&mut random)] {
            let (mut world, superpoints) = world_of(&views);
            // Outlines of boxes of 10 x 10 pixels, half of them cut off.
            let outlines = world.photos.iter_mut().flat_map(|photo| &mut photo.outlines);
            outlines.for_each(|outline| outline.cut_px = random.below(9_u32).saturating_sub(4) * 3);
            let uncut = |view: usize, mask: u32| {
                1.0 - f64::from(world.photos[view].outlines[mask as usize].cut_px) / 40.0
            };
            let found = world.objects_of(Some(&superpoints), u64::MAX, false).expect("not cancelled");
            let pairs = tree::pairs(&world.gaussians, &superpoints);
            let (expected, n_masks) = oracle(&views, &pairs, &superpoints.of_gaussian, uncut);
            let mut object_of = vec![None; superpoints.n];
            for (cell, of_cell) in world.split.cells.iter().zip(&found.object_of) {
                for (gaussian, object) in
                    cell.gaussians.iter().zip(of_cell).filter(|(_, object)| **object != NONE)
                {
                    object_of[superpoints.of_gaussian[*gaussian as usize] as usize] = Some(*object as usize);
                }
            }
            assert_eq!(object_of, expected, "seed {seed}");
            let found: Vec<usize> = found.objects.iter().map(|object| object.n_masks as usize).collect();
            assert_eq!(found, n_masks, "seed {seed}");
            n_objects += found.len();
        }
    }
    assert!(n_objects > 100, "{n_objects}");
}

/// Oracle: the views' things, in spite of masks of several, of parts and of everything.
#[test]
fn things_are_found_among_masks_of_parts_and_of_everything() {
    let (world, superpoints) = world_of(&made_views(&mut Random::new(1)));
    let found = world.objects_of(Some(&superpoints), u64::MAX, false).expect("not cancelled");
    assert_eq!(found.objects.len(), N_THINGS as usize);
    for (cell, of_cell) in world.split.cells.iter().zip(&found.object_of) {
        assert!(cell.gaussians.iter().map(|gaussian| gaussian / PER_ROW).eq(of_cell.iter().copied()));
    }
}

/// Contribution files of these views, with superpoints of ten Gaussians.
fn world_of(views: &Views) -> (World, Superpoints) {
    let n = PER_ROW * N_THINGS;
    let mean = |i: u32| DVec3::new(f64::from(i / PER_ROW) * 3.0, f64::from(i % PER_ROW) * 0.1, 0.0);
    let gaussians = Gaussians::balls((0..n).map(mean).collect(), 0.1);
    let split = split(&gaussians, CellLimits::by_count(90));
    let view = |of_view: &BTreeMap<u32, BTreeSet<u32>>| {
        let mut regions: Vec<&BTreeSet<u32>> = of_view.values().collect();
        regions.sort_unstable();
        regions.dedup();
        let n_masks = of_view.values().flatten().max().map_or(0, |last| *last as usize + 1);
        let mut entries: BTreeMap<u32, Vec<Contribution>> = BTreeMap::new();
        for (gaussian, masks) in of_view.iter().filter(|(_, masks)| !masks.is_empty()) {
            let (cell, local) =
                (split.cell_of_gaussian[*gaussian as usize], split.local_of_gaussian[*gaussian as usize]);
            let region = regions.binary_search(&masks).expect("known") as u32;
            entries.entry(cell).or_default().push(Contribution { local, region, weight: 1.0 });
        }
        entries.values_mut().for_each(|entries| entries.sort_by_key(|entry| (entry.local, entry.region)));
        ViewContributions {
            dim: DIM,
            mask_vectors: (0..n_masks).flat_map(axis).collect(),
            masks_of_region: regions.into_iter().map(|masks| masks.iter().copied().collect()).collect(),
            entries_of_cell: entries.into_iter().collect(),
        }
    };
    let views: Vec<ViewContributions> = views.iter().map(view).collect();
    let superpoints = Superpoints {
        of_gaussian: (0..n).map(|i| i / PER_SUPERPOINT).collect(),
        n: (n / PER_SUPERPOINT) as usize,
    };
    (World::new(gaussians, split, &views), superpoints)
}

/// By hand: two views have one mask for things 0 and 1; four outline thing 0 and only fill thing 1. Together they have
/// the consensus (2 + 4 / 2) / 6, thing 0 alone (2 / 2 + 4) / 6; no outline shows thing 1.
#[test]
fn what_views_outline_ends_where_they_only_fill() {
    let masks = |view: u32, gaussian: u32| BTreeSet::from([u32::from(view >= 2 && gaussian >= PER_ROW)]);
    let view = |view| (0..2 * PER_ROW).map(|gaussian| (gaussian, masks(view, gaussian))).collect();
    let (mut world, superpoints) = world_of(&(0..6).map(view).collect());
    let levels = [0, 0].into_iter().chain([0, Mask::FILLER].repeat(4));
    world.table.set_levels(levels.collect());
    let found = world.objects_of(Some(&superpoints), u64::MAX, false).expect("not cancelled");
    let sizes: Vec<u32> = found.objects.iter().map(|object| object.n_gaussians).collect();
    assert_eq!(sizes, [PER_ROW]);
}
