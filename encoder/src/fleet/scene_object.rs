//! The object of a scene: the columns of its Gaussians that an encode reads, in the world of the poses.

use slag_common::Gaussians;
use slag_common::container::{self, AlignedBytes, ContainerError, Layout};

const MAGIC: [u8; 8] = *b"SLAGSCEN";
const VERSION: u32 = 1;

/// Returns the object of a scene. Coefficients of higher degree are left out: an encode does not read them.
pub(super) fn pack(scene: &Gaussians) -> std::io::Result<Vec<u8>> {
    let n = scene.len() as u64;
    let sections = [
        (1, bytemuck::bytes_of(&n)),
        (2, bytemuck::cast_slice(&scene.means_in_world)),
        (3, bytemuck::cast_slice(&scene.rotations_wxyz)),
        (4, bytemuck::cast_slice(&scene.scales)),
        (5, bytemuck::cast_slice(&scene.opacities)),
        (6, bytemuck::cast_slice(&scene.sh_dc)),
    ];
    let mut bytes = Vec::new();
    container::write(&mut bytes, MAGIC, VERSION, &sections)?;
    Ok(bytes)
}

/// Reads the object of a scene.
///
/// # Errors
/// [`ContainerError`], naming the byte.
pub(super) fn unpack(bytes: &[u8]) -> Result<Gaussians, ContainerError> {
    let bytes = AlignedBytes::copy_of(bytes);
    let layout = Layout::check(&bytes, MAGIC, VERSION)?;
    let n = usize::try_from(layout.value::<u64>(&bytes, 1, "number of Gaussians")?).unwrap_or(usize::MAX);
    Ok(Gaussians {
        means_in_world: bytemuck::pod_collect_to_vec(&bytes[layout.column::<[f64; 3]>(2, "means", n)?]),
        rotations_wxyz: bytemuck::pod_collect_to_vec(&bytes[layout.column::<[f32; 4]>(3, "rotations", n)?]),
        scales: bytemuck::pod_collect_to_vec(&bytes[layout.column::<[f32; 3]>(4, "scales", n)?]),
        opacities: bytemuck::pod_collect_to_vec(&bytes[layout.column::<f32>(5, "opacities", n)?]),
        sh_dc: bytemuck::pod_collect_to_vec(&bytes[layout.column::<[f32; 3]>(6, "colours", n)?]),
        sh_rest: Vec::new(),
        sh_degree: 0,
    })
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;

    #[test]
    fn a_scene_comes_back_bit_by_bit() {
        let scene = Gaussians {
            means_in_world: vec![DVec3::new(0.1, f64::NAN, -1e300), DVec3::splat(1.0 / 3.0)],
            rotations_wxyz: vec![[1.0, 0.0, 0.0, -0.0], [0.5; 4]],
            scales: vec![[0.1; 3], [f32::INFINITY; 3]],
            opacities: vec![0.25, 1.0],
            sh_dc: vec![[0.5; 3], [-0.5; 3]],
            sh_rest: Vec::new(),
            sh_degree: 0,
        };
        let bytes = pack(&scene).expect("packs");
        // NaN differs from itself, so the columns are compared by their bytes.
        assert_eq!(pack(&unpack(&bytes).expect("reads")).expect("packs"), bytes);
        unpack(&bytes[..bytes.len() - 1]).expect_err("cut");
    }
}
