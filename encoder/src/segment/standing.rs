//! Masks of what stands on the ground, beside those of another segmenter.

use std::ops::Range;
use std::sync::Arc;

use glam::DVec3;

use super::{SegmentError, SegmentInput, Segmenter};
use crate::ground::{NO_THING, Standing};
use crate::lanes::GpuLoad;
use crate::masks::{BoxPx, Mask, NO_REGION, masks_of_labels};

/// Smallest mask, pixels: a traffic cone from 40 m.
const MIN_AREA_PX: u32 = 24;
/// Largest share of a photo: nearer things show their parts better.
const MAX_AREA: f64 = 0.1;
/// A mask this similar to another one is left out.
const SAME_IOU: f64 = 0.8;

const _: () = assert!(NO_THING == NO_REGION);

/// A segmenter whose masks are joined by those of standing things.
pub(crate) struct WithStanding<S> {
    pub(crate) other: S,
    pub(crate) standing: Arc<Standing>,
}

impl<S: Segmenter> Segmenter for WithStanding<S> {
    fn identity(&self) -> String {
        format!("{}, standing 1", self.other.identity())
    }

    fn wants_depth(&self) -> bool {
        !self.standing.is_empty() || self.other.wants_depth()
    }

    fn concurrency(&self) -> Option<usize> {
        self.other.concurrency()
    }

    fn loads(&self) -> Vec<GpuLoad> {
        self.other.loads()
    }

    fn segment(&self, input: &SegmentInput<'_>) -> Result<Vec<Mask>, SegmentError> {
        let mut masks = self.other.segment(input)?;
        let mut standing = masks_of(&self.standing, input);
        let outlined = masks.iter().filter(|mask| mask.level != Mask::FILLER);
        let outlined: Vec<&Mask> = outlined.collect();
        standing.retain(|mask| outlined.iter().all(|other| iou(mask, other) < SAME_IOU));
        // A filler is for pixels without any other mask.
        for filler in masks.iter_mut().filter(|mask| mask.level == Mask::FILLER) {
            standing.iter().for_each(|mask| take_out(filler, mask));
        }
        masks.retain(|mask| mask.area_px > 0);
        masks.append(&mut standing);
        Ok(masks)
    }
}

/// Masks of standing things: the pixels whose depth leads to them.
fn masks_of(standing: &Standing, input: &SegmentInput<'_>) -> Vec<Mask> {
    let Some(depth) = input.depth.filter(|_| !standing.is_empty()) else { return Vec::new() };
    let camera = &input.view.intrinsics;
    let world_from_camera = input.view.camera_from_world.inverse();
    let thing = |(at, z): (usize, &f32)| {
        let is_valid = input.valid.is_none_or(|valid| valid[at]);
        if !(is_valid && *z > 0.0) {
            return NO_REGION;
        }
        let (column, row) = (at as u32 % camera.width_px, at as u32 / camera.width_px);
        let x = (f64::from(column) + 0.5 - camera.centre_x_px) / camera.focal_x_px;
        let y = (f64::from(row) + 0.5 - camera.centre_y_px) / camera.focal_y_px;
        standing.shown_at(world_from_camera.transform_point3(f64::from(*z) * DVec3::new(x, y, 1.0)))
    };
    let labels: Vec<u32> = depth.iter().enumerate().map(thing).collect();
    let max_area_px = (MAX_AREA * labels.len() as f64) as u32;
    let masks = masks_of_labels(&labels, camera.width_px, standing.n_things(), u64::MAX);
    let masks = masks.unwrap_or_default().into_iter().map(|(_, mask)| Mask { level: Mask::STANDING, ..mask });
    masks.filter(|mask| (MIN_AREA_PX..=max_area_px).contains(&mask.area_px)).collect()
}

fn common(a: &BoxPx, b: &BoxPx) -> [Range<u32>; 2] {
    [a.x0.max(b.x0)..a.x1.min(b.x1), a.y0.max(b.y0)..a.y1.min(b.y1)]
}

fn iou(a: &Mask, b: &Mask) -> f64 {
    let [columns, rows] = common(&a.box_px, &b.box_px);
    let in_both = |y: u32| columns.clone().filter(|x| a.contains(*x, y) && b.contains(*x, y)).count();
    let both: usize = rows.map(in_both).sum();
    both as f64 / (f64::from(a.area_px) + f64::from(b.area_px) - both as f64)
}

/// Takes another mask's pixels out; the box stays.
fn take_out(mask: &mut Mask, other: &Mask) {
    let [columns, rows] = common(&mask.box_px, &other.box_px);
    for y in rows {
        for x in columns.clone().filter(|x| other.contains(*x, y)) {
            let at = mask.box_px.place_of(x, y);
            mask.area_px -= u32::from(mask.inside.get(at));
            mask.inside.set(at, false);
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::{DAffine3, DMat3};
    use slag_common::{Gaussians, View};

    use super::*;
    use crate::raster::pinhole;

    /// A park of 60 x 60 m and two cars of 4 x 2 x 1 m, 2 m apart, in one colour; a Gaussian every 10 cm.
    fn park() -> Gaussians {
        let ground =
            (0..360_000).map(|i| (f64::from(i % 600) * 0.1 - 30.0, f64::from(i / 600) * 0.1 - 30.0, 0.0));
        let cars = (0..800).flat_map(|i| [(i, -2.0), (i, 2.0)]);
        let cars = cars.map(|(i, y)| (f64::from(i % 40) * 0.1 - 2.0, f64::from(i / 40) * 0.1 + y - 1.0, 1.0));
        let mut scene = Gaussians::balls(ground.chain(cars).map(Into::into).collect(), 0.1);
        scene.scales.fill([0.1, 0.1, 0.01]);
        scene.opacities.fill(0.9);
        scene
    }

    /// A camera 21 m high that looks down, where a pixel is 5 cm of a roof.
    fn from_above() -> View {
        let down = DMat3::from_cols(DVec3::X, DVec3::NEG_Y, DVec3::NEG_Z);
        View {
            name: "a".into(),
            image_path: "a".into(),
            intrinsics: pinhole([200, 200], 400.0),
            camera_from_world: DAffine3::from_mat3_translation(down, down * DVec3::new(0.0, 0.0, -21.0)),
        }
    }

    struct Whole;

    impl Segmenter for Whole {
        fn identity(&self) -> String {
            "whole".into()
        }

        fn segment(&self, input: &SegmentInput<'_>) -> Result<Vec<Mask>, SegmentError> {
            let (x1, y1) = input.image.dimensions();
            Ok(vec![Mask { level: Mask::FILLER, ..Mask::whole(BoxPx { x0: 0, y0: 0, x1, y1 }) }])
        }
    }

    /// By hand: the roofs fill 80 x 40 pixels each, however the world is turned; the filler keeps the rest.
    #[test]
    fn cars_stand_on_their_park() {
        for turn in [DMat3::IDENTITY, DMat3::from_rotation_x(2.0) * DMat3::from_rotation_y(0.5)] {
            let (mut scene, mut view) = (park(), from_above());
            let rotation = glam::DQuat::from_mat3(&turn).as_quat();
            scene.means_in_world.iter_mut().for_each(|mean| *mean = turn * *mean);
            scene.rotations_wxyz.fill([rotation.w, rotation.x, rotation.y, rotation.z]);
            view.camera_from_world *= DAffine3::from_mat3(turn.transpose());
            let is_car = |at: usize| {
                let (x, y) = (at % 200, at / 200);
                (60..140).contains(&x) && ((40..80).contains(&y) || (120..160).contains(&y))
            };
            let depth: Vec<f32> = (0..40_000).map(|at| if is_car(at) { 20.0 } else { 21.0 }).collect();
            let image = image::RgbImage::new(200, 200);
            let input = SegmentInput {
                view: &view,
                image: &image,
                valid: None,
                undistorter: None,
                depth: Some(&depth),
                pool: None,
            };
            let standing = Arc::new(Standing::find(&scene, std::slice::from_ref(&view)));
            assert_eq!(standing.n_things(), 2);
            let masks = WithStanding { other: Whole, standing }.segment(&input).expect("masks");
            let found: Vec<(u8, u32)> = masks.iter().map(|mask| (mask.level, mask.area_px)).collect();
            let car = (Mask::STANDING, 80 * 40);
            assert_eq!(found, [(Mask::FILLER, 40_000 - 2 * 80 * 40), car, car]);
            let mut boxes: Vec<BoxPx> = masks[1..].iter().map(|mask| mask.box_px).collect();
            boxes.sort_by_key(|b| b.y0);
            assert_eq!(boxes[0], BoxPx { x0: 60, y0: 40, x1: 140, y1: 80 });
        }
    }

    /// The other segmenter's masks stay, and what they show is not added again.
    #[test]
    fn what_is_outlined_already_is_not_added() {
        let mask = |x1: u32| Mask::whole(BoxPx { x0: 0, y0: 0, x1, y1: 10 });
        assert!(iou(&mask(10), &mask(8)) >= SAME_IOU && iou(&mask(10), &mask(7)) < SAME_IOU);
        let mut whole = mask(10);
        take_out(&mut whole, &mask(4));
        assert_eq!((whole.area_px, whole.contains(3, 0), whole.contains(4, 0)), (60, false, true));
    }
}
