//! Small pictures of a shard's objects, each cut from the photo that shows the object best.

use crate::container::{ContainerError, Layout, damaged};

pub mod section {
    /// `[n_objects]` u32: the end of each picture, ascending; an object without one has an empty one.
    pub const ENDS: u32 = 29;
    /// JPEG files, one after the other.
    pub const PICTURES: u32 = 30;
}

pub const MAX_THUMBNAIL_BYTES: usize = 16 << 10;

/// The first bytes of JPEG files.
const JPEG: [u8; 3] = [0xff, 0xd8, 0xff];

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Thumbnails<'a> {
    /// `[n_objects]`.
    pub ends: &'a [u32],
    pub pictures: &'a [u8],
}

impl<'a> Thumbnails<'a> {
    pub(super) fn of(bytes: &'a [u8], layout: &Layout) -> Option<Self> {
        let pictures = layout.find(section::PICTURES)?;
        Some(Self { ends: layout.slice(bytes, section::ENDS), pictures: &bytes[pictures] })
    }

    pub fn get(&self, object: usize) -> Option<&'a [u8]> {
        let start = object.checked_sub(1).map_or(0, |before| self.ends[before]);
        let picture = &self.pictures[start as usize..self.ends[object] as usize];
        (!picture.is_empty()).then_some(picture)
    }

    pub(super) fn sections(&self) -> [(u32, &'a [u8]); 2] {
        [(section::ENDS, bytemuck::cast_slice(self.ends)), (section::PICTURES, self.pictures)]
    }
}

/// Checks the pictures of a shard of `n` objects, if it has any.
pub(super) fn check(bytes: &[u8], layout: &Layout, n: usize) -> Result<(), ContainerError> {
    let Some(pictures) = layout.find(section::PICTURES) else { return Ok(()) };
    let at_ends = layout.column::<u32>(section::ENDS, "ends of the thumbnails", n)?;
    let ends: Vec<u32> = bytemuck::pod_collect_to_vec(&bytes[at_ends.clone()]);
    let len = pictures.len();
    if !ends.is_sorted() || ends.last().map_or(0, |end| *end as usize) != len {
        let what = format!("the ends of the thumbnails do not ascend to {len}");
        return Err(damaged(at_ends.start, what));
    }
    let view = Thumbnails { ends: &ends, pictures: &bytes[pictures.clone()] };
    let is_sound = |picture: &[u8]| picture.len() <= MAX_THUMBNAIL_BYTES && picture.starts_with(&JPEG);
    match (0..n).find(|object| view.get(*object).is_some_and(|picture| !is_sound(picture))) {
        Some(object) => {
            let expected = format!("no JPEG file of at most {MAX_THUMBNAIL_BYTES} bytes");
            Err(damaged(pictures.start, format!("the thumbnail of object {object} is {expected}")))
        }
        None => Ok(()),
    }
}
