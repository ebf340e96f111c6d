//! Matches features of a photo with landmarks.

use std::collections::{BTreeMap, BTreeSet};

use glam::{DAffine3, DVec2};

use crate::map::{Code, Map, distance};
use crate::pose::{Match, Pinhole};

/// Largest difference of a feature and its landmark, bits.
const MAX_DISTANCE: u32 = 40;
/// Largest distance as a share of that to the second best place.
const MAX_RATIO: f32 = 0.8;
/// The same among the landmarks of a few views, where fewer are similar by chance.
const MAX_RATIO_OF_VIEWS: f32 = 0.9;
/// Largest descriptor distance, bits, to a landmark that the pose predicts.
const MAX_GUIDED_DISTANCE: u32 = 44;
/// Radius around a feature within which its landmark lies, given the pose, pixels.
const GUIDED_PX: f64 = 12.0;
const N_VIEWS: usize = 8;
/// Views around which landmarks are matched separately.
const N_PLACES: usize = 8;

/// The features to match: positions in an ideal pinhole's image, pixels, and codes.
pub(crate) struct Query {
    pub(crate) at: Vec<DVec2>,
    pub(crate) codes: Vec<Code>,
}

impl Query {
    fn matched(&self, map: &Map, feature: usize, landmark: u32) -> Match {
        let landmark = landmark as usize;
        let point_in_world = map.landmarks[landmark].position_in_world;
        Match { feature, landmark, at: self.at[feature], point_in_world }
    }

    pub(crate) fn match_all(&self, map: &Map) -> Vec<Match> {
        let all: Vec<u32> = (0..map.landmarks.len() as u32).collect();
        self.match_among(map, &all, MAX_RATIO)
    }

    /// Matches features with the landmarks of the views with most `votes`.
    pub(crate) fn match_views(&self, map: &Map, votes: &[Match]) -> Vec<Match> {
        let mut of_views: BTreeMap<u16, usize> = BTreeMap::new();
        for vote in votes {
            *of_views.entry(map.landmarks[vote.landmark].view).or_default() += 1;
        }
        let views = ranked(of_views).into_iter().take(N_VIEWS);
        let landmarks: Vec<u32> = views.flat_map(|view| map.of_views[&view].clone()).collect();
        self.match_among(map, &landmarks, MAX_RATIO_OF_VIEWS)
    }

    /// Matches features with the landmarks around each of the views with most votes: a feature votes for all views
    /// with a landmark nearly as similar as the best.
    pub(crate) fn match_places<'a>(&'a self, map: &'a Map) -> impl Iterator<Item = Vec<Match>> + use<'a> {
        let mut votes: BTreeMap<u16, usize> = BTreeMap::new();
        for code in &self.codes {
            let distances = map.landmarks.iter().map(|landmark| distance(*code, landmark.code));
            let distances: Vec<u32> = distances.collect();
            let least = distances.iter().copied().min().unwrap_or(u32::MAX);
            let limit = MAX_DISTANCE.min((least as f32 / MAX_RATIO_OF_VIEWS) as u32);
            let near = distances.iter().zip(&map.landmarks).filter(|(bits, _)| **bits <= limit);
            let views: BTreeSet<u16> = near.map(|(_, landmark)| landmark.view).collect();
            views.into_iter().for_each(|view| *votes.entry(view).or_default() += 1);
        }
        let views = ranked(votes).into_iter().take(N_PLACES);
        views.map(move |view| self.match_among(map, &map.around(view, N_VIEWS), MAX_RATIO_OF_VIEWS))
    }

    fn match_among(&self, map: &Map, landmarks: &[u32], max_ratio: f32) -> Vec<Match> {
        let codes: Vec<Code> = landmarks.iter().map(|at| map.landmarks[*at as usize].code).collect();
        let place = |at: usize| map.landmarks[landmarks[at] as usize].position_in_world;
        let one = |(feature, code): (usize, &Code)| {
            let distances: Vec<u32> = codes.iter().map(|other| distance(*code, *other)).collect();
            let (best, least) = distances.iter().copied().enumerate().min_by_key(|(at, d)| (*d, *at))?;
            let limit = least as f32 / max_ratio;
            // A rival is as near, and at another place.
            let is_rival = |(at, d): (usize, &u32)| {
                (*d as f32) < limit && place(at).distance_squared(place(best)) > map.same_place
            };
            let is_match = least <= MAX_DISTANCE && !distances.iter().enumerate().any(is_rival);
            is_match.then(|| self.matched(map, feature, landmarks[best]))
        };
        self.codes.iter().enumerate().filter_map(one).collect()
    }

    /// Matches features with the most similar landmark that a pose predicts nearby; a landmark has one feature.
    pub(crate) fn match_guided(
        &self,
        map: &Map,
        camera: &Pinhole,
        pose: &DAffine3,
        size_px: DVec2,
    ) -> Vec<Match> {
        let bin = |at: DVec2| ((at.x / GUIDED_PX).floor() as i64, (at.y / GUIDED_PX).floor() as i64);
        let mut bins: BTreeMap<(i64, i64), Vec<(u32, DVec2)>> = BTreeMap::new();
        for (index, landmark) in (0..).zip(&map.landmarks) {
            let pixel = camera.pixel(pose.transform_point3(landmark.position_in_world));
            let Some(pixel) = pixel.filter(|at| at.cmpge(DVec2::ZERO).all() && at.cmplt(size_px).all())
            else {
                continue;
            };
            bins.entry(bin(pixel)).or_default().push((index, pixel));
        }
        let mut of_landmark: BTreeMap<u32, (u32, usize)> = BTreeMap::new();
        for (feature, (at, code)) in self.at.iter().zip(&self.codes).enumerate() {
            let (x, y) = bin(*at);
            let around = (x - 1..=x + 1).flat_map(|x| (y - 1..=y + 1).map(move |y| (x, y)));
            let near = around.filter_map(|bin| bins.get(&bin)).flatten();
            let near = near.filter(|(_, pixel)| pixel.distance(*at) < GUIDED_PX);
            let alike = near.map(|(index, _)| (distance(*code, map.landmarks[*index as usize].code), *index));
            let Some((bits, landmark)) = alike.min().filter(|(bits, _)| *bits <= MAX_GUIDED_DISTANCE) else {
                continue;
            };
            let best = of_landmark.entry(landmark).or_insert((bits, feature));
            *best = (*best).min((bits, feature));
        }
        of_landmark.into_iter().map(|(landmark, (_, feature))| self.matched(map, feature, landmark)).collect()
    }
}

fn ranked(votes: BTreeMap<u16, usize>) -> Vec<u16> {
    let mut views: Vec<(u16, usize)> = votes.into_iter().collect();
    views.sort_by_key(|(view, n)| (std::cmp::Reverse(*n), *view));
    views.into_iter().map(|(view, _)| view).collect()
}
