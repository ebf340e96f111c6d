//! A shard: one cell's data in one file. The byte table and its reasons are in `FORMAT.md`.
//!
//! Gaussians are ordered by codebook centroid, then along a Morton curve, so a centroid's members are one
//! run `centroid_starts[r]..centroid_starts[r + 1]` and no code column exists; those without evidence follow
//! the last run and have no centroid.
//!
//! Rows are 8-bit components in a basis of the cell's own, for a cell's embeddings fill few dimensions:
//! `P[r] = mean + centroid_step * sum over c of centroids[r][c] * basis_steps[c] * basis[c]`. A residual code adds
//! `scale[r] * codeword` to subspaces of components, a codeword of 16 for each subspace:
//! `E ~ P[r] + scale[r] * sum over g of sum over c in subspace g of codewords[g][code][c] * basis_steps[c] * basis[c]`.

mod check;

use std::io;
use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use glam::DVec3;
use half::f16;
use serde::{Deserialize, Serialize};

use crate::container;
use crate::frames::Aabb;
use crate::hash::Hash32;
use crate::objects::{Objects, ObjectsLayout};

/// First bytes of a shard.
pub const MAGIC: [u8; 8] = *b"SLAGSHRD";
/// Version of the shard format that is written and read.
pub const VERSION: u32 = 2;
/// Gaussians whose residual codes lie together, one byte column after the other.
pub const BLOCK: usize = 32;
/// Words of a subspace of components: a code is half a byte.
pub const CODEWORDS: usize = 16;
/// Most subspaces of a residual code.
pub const MAX_SUBSPACES: usize = 128;
/// Larger than any text-image model's embedding; a larger stated `dim` is damage.
pub const MAX_DIM: usize = 8192;

/// Ids of a shard's sections.
pub mod section {
    /// [`super::ShardHeader`].
    pub const HEADER: u32 = 1;
    /// `[N]` u32 or `[N][3]` u16, see [`super::Positions`].
    pub const POSITIONS: u32 = 2;
    /// `[K + 1]` u32.
    pub const CENTROID_STARTS: u32 = 3;
    /// `[K][m]` i8.
    pub const CENTROIDS: u32 = 4;
    /// `[K]` f32.
    pub const RADII: u32 = 5;
    /// `[N]` u32, index in the input splat file.
    pub const INPUT_INDICES: u32 = 6;
    /// `[centroid_starts[K]][dim]` f16, unit embeddings.
    pub const EMBEDDINGS: u32 = 7;
    /// `[dim]` f16; absent: zero.
    pub const MEAN: u32 = 8;
    /// `[m][dim]` i8; absent: the components are the embedding's own, m = dim.
    pub const BASIS: u32 = 9;
    /// `[m]` f32, with the basis.
    pub const BASIS_STEPS: u32 = 10;
    /// `[G + 1]` u32: subspace g has the components from `starts[g]` to `starts[g + 1]`.
    pub const SUBSPACE_STARTS: u32 = 11;
    /// Group by subspace `[16][components of the subspace]` f16.
    pub const CODEWORDS: u32 = 12;
    /// `[K]` f32: what a centroid's codewords are multiplied by.
    pub const RESIDUAL_SCALES: u32 = 13;
    /// `[K]` f32: length of the largest residual of a centroid's members as decoded, in components.
    pub const RESIDUAL_NORMS: u32 = 14;
    /// `[ceil(centroid_starts[K] / 32)][G / 2][32]` u8: two codes a byte, the even subspace's in the low half.
    pub const CODES: u32 = 15;
    /// [`super::ScoreErrors`] of the fine residuals.
    pub const FINE_ERRORS: u32 = 16;
    /// `[m]` f32: what a fine residual's components are multiplied by.
    pub const FINE_STEPS: u32 = 17;
    /// `[K]` f32: what those of a centroid's members are multiplied by.
    pub const FINE_SCALES: u32 = 18;
    /// `[centroid_starts[K]][m]` i8.
    pub const FINE: u32 = 19;
}

/// How much a shard carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Profile {
    /// Codebook centroids and positions.
    Compact,
    /// Also a residual code of each embedding.
    Balanced,
    /// Codebook centroids, positions and every embedding as f16.
    Exact,
}

impl Profile {
    /// Every profile, smallest first.
    pub const ALL: [Self; 3] = [Self::Compact, Self::Balanced, Self::Exact];

    /// Returns the name used in manifests, URLs and flags.
    pub fn name(self) -> &'static str {
        match self {
            Self::Compact => "compact",
            Self::Balanced => "balanced",
            Self::Exact => "exact",
        }
    }
}

impl std::fmt::Display for Profile {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

impl std::str::FromStr for Profile {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let names = || Self::ALL.map(Self::name).join(", ");
        Self::ALL
            .into_iter()
            .find(|p| p.name() == text)
            .ok_or_else(|| format!("{text:?} is no profile; there are: {}", names()))
    }
}

/// Errors of a profile's scores over a bank of text vectors, measured when it was made: absolute, of
/// cosines; on a sample of the Gaussians.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[repr(C)]
pub struct ScoreErrors {
    /// Mean over texts and Gaussians.
    pub mean: f32,
    /// 99.9th percentile.
    pub p999: f32,
    /// Largest.
    pub max: f32,
    /// Standard deviation over the Gaussians of a text's scores, mean over the texts: what an error is
    /// to be compared with.
    pub spread: f32,
}

/// The fixed part of a shard.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct ShardHeader {
    /// The cell.
    pub cell_id: u32,
    /// Gaussians, N.
    pub n_gaussians: u32,
    /// Codebook centroids, K.
    pub n_centroids: u32,
    /// Components of an embedding.
    pub dim: u32,
    /// Components of a centroid, m.
    pub n_components: u32,
    /// Groups of components of the residual code, G; even; 0 without one.
    pub n_subspaces: u32,
    /// Bits of a position's x, y and z, 32 in all at most; 16 each where they are kept as u16.
    pub position_bits: [u8; 4],
    /// What a centroid's 8-bit components are multiplied by.
    pub centroid_step: f32,
    /// Where the shard frame's origin lies in the world frame.
    pub origin_in_world: [f64; 3],
    /// World units per step of a quantised position, per axis; the error is at most half a step.
    pub position_step: [f64; 3],
    /// Smallest corner of the box around the Gaussians' extents, world frame.
    pub box_min: [f64; 3],
    /// Largest corner.
    pub box_max: [f64; 3],
    /// Measured errors of this profile; beside exact embeddings, of the residual code.
    pub errors: ScoreErrors,
    /// The encoder whose space the centroids live in.
    pub encoder_id: [u8; 32],
}

/// Quantised means, steps of `position_step` from `origin_in_world`.
#[derive(Clone, Copy, Debug)]
pub enum Positions<'a> {
    /// x, y and z from the lowest bit up, `position_bits` wide.
    Packed(&'a [u32]),
    /// x, y, z.
    Wide(&'a [[u16; 3]]),
}

impl Positions<'_> {
    fn bytes(&self) -> &[u8] {
        match self {
            Self::Packed(codewords) => container::bytes_of(codewords),
            Self::Wide(steps) => container::bytes_of(steps),
        }
    }

    fn steps(&self, index: usize, bits: [u8; 4]) -> [u32; 3] {
        match self {
            Self::Wide(steps) => steps[index].map(u32::from),
            Self::Packed(codewords) => {
                let codeword = u64::from(codewords[index]);
                let part = |shift: u8, bits: u8| (codeword >> shift & ((1 << bits) - 1)) as u32;
                [part(0, bits[0]), part(bits[0], bits[1]), part(bits[0] + bits[1], bits[2])]
            }
        }
    }
}

/// The basis of a cell's centroids.
#[derive(Clone, Copy, Debug)]
pub struct Basis<'a> {
    /// `[dim]`.
    pub mean: &'a [f16],
    /// `[m][dim]`.
    pub vectors: &'a [i8],
    /// `[m]`.
    pub steps: &'a [f32],
}

/// The residual code.
#[derive(Clone, Copy, Debug)]
pub struct Residuals<'a> {
    /// `[G + 1]`, strictly ascending, at most m.
    pub subspace_starts: &'a [u32],
    /// Group by subspace `[16][components of the subspace]`.
    pub codewords: &'a [f16],
    /// `[K]`.
    pub residual_scales: &'a [f32],
    /// `[K]`: no member's decoded residual is longer, as a vector of components.
    pub residual_norms: &'a [f32],
    /// `[ceil(centroid_starts[K] / 32)][G / 2][32]`.
    pub codes: &'a [u8],
}

impl Residuals<'_> {
    /// Returns the codeword that a Gaussian's code names in a subspace.
    pub fn code(&self, index: usize, subspace: usize) -> usize {
        let n_bytes = (self.subspace_starts.len() - 1) / 2;
        let byte = self.codes[(index / BLOCK * n_bytes + subspace / 2) * BLOCK + index % BLOCK];
        usize::from(if subspace.is_multiple_of(2) { byte & 15 } else { byte >> 4 })
    }
}

/// The exact profile's columns.
#[derive(Clone, Copy, Debug)]
pub struct ExactColumns<'a> {
    /// `[N]` index in the input splat file.
    pub input_indices: &'a [u32],
    /// `[centroid_starts[K]][dim]` unit embeddings.
    pub embeddings: &'a [f16],
    /// What lies between codes and embeddings; absent where there is no code.
    pub fine: Option<Fine<'a>>,
}

/// Residuals in 8 bits a component: a Gaussian's lie together, an eighth of its embedding's bytes.
#[derive(Clone, Copy, Debug)]
pub struct Fine<'a> {
    /// Measured errors of their scores.
    pub errors: ScoreErrors,
    /// `[m]`.
    pub steps: &'a [f32],
    /// `[K]`.
    pub scales: &'a [f32],
    /// `[centroid_starts[K]][m]`.
    pub values: &'a [i8],
}

/// A shard's columns, borrowed from its bytes, or from what it is to be written from.
#[derive(Clone, Copy, Debug)]
pub struct ShardView<'a> {
    /// The fixed part.
    pub header: ShardHeader,
    /// `[N]`; decode with [`ShardView::position_in_world`].
    pub positions: Positions<'a>,
    /// `[K + 1]`, ascending.
    pub centroid_starts: &'a [u32],
    /// `[K][m]`.
    pub centroids: &'a [i8],
    /// `[K]`: at least the largest `||E_k - E'_k||` of the centroid's members, E' as this profile decodes it
    /// (the centroid, or centroid and residual); beside exact embeddings, of the centroid.
    pub radii: &'a [f32],
    /// What the centroids' components mean; absent: they are the embedding's own.
    pub basis: Option<Basis<'a>>,
    /// What only the balanced profile has.
    pub residuals: Option<Residuals<'a>>,
    /// What only the exact profile has.
    pub exact: Option<ExactColumns<'a>>,
}

impl ShardView<'_> {
    /// Writes the shard.
    ///
    /// # Errors
    /// Whatever the writer gives.
    pub fn write(&self, out: impl io::Write) -> io::Result<()> {
        self.write_with(out, None)
    }

    /// Writes the shard and the objects that its Gaussians belong to.
    ///
    /// # Errors
    /// Whatever the writer gives.
    pub fn write_with(&self, out: impl io::Write, objects: Option<&Objects<'_>>) -> io::Result<()> {
        let mut sections = vec![
            (section::HEADER, bytemuck::bytes_of(&self.header)),
            (section::POSITIONS, self.positions.bytes()),
            (section::CENTROID_STARTS, container::bytes_of(self.centroid_starts)),
            (section::CENTROIDS, container::bytes_of(self.centroids)),
            (section::RADII, container::bytes_of(self.radii)),
        ];
        if let Some(basis) = &self.basis {
            sections.push((section::MEAN, container::bytes_of(basis.mean)));
            sections.push((section::BASIS, container::bytes_of(basis.vectors)));
            sections.push((section::BASIS_STEPS, container::bytes_of(basis.steps)));
        }
        if let Some(residuals) = &self.residuals {
            sections.push((section::SUBSPACE_STARTS, container::bytes_of(residuals.subspace_starts)));
            sections.push((section::CODEWORDS, container::bytes_of(residuals.codewords)));
            sections.push((section::RESIDUAL_SCALES, container::bytes_of(residuals.residual_scales)));
            sections.push((section::RESIDUAL_NORMS, container::bytes_of(residuals.residual_norms)));
            sections.push((section::CODES, residuals.codes));
        }
        if let Some(exact) = &self.exact {
            sections.push((section::INPUT_INDICES, container::bytes_of(exact.input_indices)));
            sections.push((section::EMBEDDINGS, container::bytes_of(exact.embeddings)));
            if let Some(fine) = &exact.fine {
                sections.push((section::FINE_ERRORS, bytemuck::bytes_of(&fine.errors)));
                sections.push((section::FINE_STEPS, container::bytes_of(fine.steps)));
                sections.push((section::FINE_SCALES, container::bytes_of(fine.scales)));
                sections.push((section::FINE, container::bytes_of(fine.values)));
            }
        }
        sections.extend(objects.iter().flat_map(|objects| objects.sections()));
        container::write(out, MAGIC, VERSION, &sections)
    }

    /// Returns the mean of a Gaussian, exact to half a step per axis.
    pub fn position_in_world(&self, index: usize) -> DVec3 {
        let steps = self.positions.steps(index, self.header.position_bits).map(f64::from);
        DVec3::from(self.header.origin_in_world) + DVec3::from(steps) * DVec3::from(self.header.position_step)
    }

    /// Returns the box that positions can reach.
    pub fn position_box(&self) -> Aabb {
        let steps = self.header.position_bits.map(|bits| ((1u64 << bits) - 1) as f64);
        let min = DVec3::from(self.header.origin_in_world);
        let size = DVec3::new(steps[0], steps[1], steps[2]) * DVec3::from(self.header.position_step);
        Aabb { min, max: min + size }
    }

    /// Returns the members of a centroid.
    pub fn members(&self, centroid: usize) -> Range<usize> {
        self.centroid_starts[centroid] as usize..self.centroid_starts[centroid + 1] as usize
    }

    /// Returns the centroid of a Gaussian that has evidence.
    pub fn row_of(&self, index: usize) -> usize {
        self.centroid_starts.partition_point(|start| *start as usize <= index) - 1
    }

    /// Returns the number of Gaussians that have an embedding.
    pub fn n_with_evidence(&self) -> usize {
        self.centroid_starts[self.header.n_centroids as usize] as usize
    }

    /// Returns the box around the Gaussians' extents.
    pub fn bounds(&self) -> Aabb {
        Aabb { min: self.header.box_min.into(), max: self.header.box_max.into() }
    }

    /// Returns the encoder whose space the centroids live in.
    pub fn encoder_id(&self) -> Hash32 {
        Hash32(self.header.encoder_id)
    }

    /// Writes a centroid's vector to `out` (`[dim]`): the formula of the module, in float64.
    pub fn decode_centroid(&self, centroid: usize, out: &mut [f64]) {
        let m = self.header.n_components as usize;
        let step = f64::from(self.header.centroid_step);
        let components: Vec<f64> =
            self.centroids[centroid * m..][..m].iter().map(|c| f64::from(*c) * step).collect();
        self.combine(&components, out);
    }

    /// Writes the embedding of a Gaussian with evidence, as well as this profile knows it, to `out`
    /// (`[dim]`), in float64.
    pub fn decode(&self, index: usize, out: &mut [f64]) {
        let dim = self.header.dim as usize;
        if let Some(exact) = &self.exact {
            let stored = &exact.embeddings[index * dim..][..dim];
            out.iter_mut().zip(stored).for_each(|(o, v)| *o = v.to_f64());
            return;
        }
        self.combine(&self.components(index), out);
    }

    /// Writes the embedding of a Gaussian with evidence as its fine residual has it to `out` (`[dim]`), in
    /// float64; of shards that have those.
    pub fn decode_fine(&self, index: usize, fine: &Fine<'_>, out: &mut [f64]) {
        let m = self.header.n_components as usize;
        let centroid = self.row_of(index);
        let (step, scale) = (f64::from(self.header.centroid_step), f64::from(fine.scales[centroid]));
        let of_centroid = self.centroids[centroid * m..][..m].iter().map(|c| f64::from(*c) * step);
        let residual = fine.values[index * m..][..m].iter().zip(fine.steps);
        let residual = residual.map(|(v, step)| f64::from(*v) * f64::from(*step) * scale);
        self.combine(&of_centroid.zip(residual).map(|(a, b)| a + b).collect::<Vec<_>>(), out);
    }

    /// Returns the scores of a query (`[dim]`) and every Gaussian with evidence, as this profile decodes them,
    /// in float64.
    pub fn scores(&self, query: &[f32]) -> Vec<f64> {
        let dim = self.header.dim as usize;
        let product = |vector: &mut dyn Iterator<Item = f64>| -> f64 {
            vector.zip(query).map(|(v, q)| v * f64::from(*q)).sum()
        };
        if let Some(exact) = &self.exact {
            return exact
                .embeddings
                .chunks_exact(dim)
                .map(|e| product(&mut e.iter().map(|v| v.to_f64())))
                .collect();
        }
        let (offset, of_components) = self.components_of_query(query);
        let score = |index| {
            let components = self.components(index);
            offset + components.iter().zip(&of_components).map(|(c, q)| c * q).sum::<f64>()
        };
        (0..self.n_with_evidence()).map(score).collect()
    }

    /// Returns what a query (`[dim]`) gives any vector, and what it gives each component (`[m]`), in float64.
    pub fn components_of_query(&self, query: &[f32]) -> (f64, Vec<f64>) {
        let dim = self.header.dim as usize;
        let product = |vector: &mut dyn Iterator<Item = f64>| -> f64 {
            vector.zip(query).map(|(v, q)| v * f64::from(*q)).sum()
        };
        match &self.basis {
            None => (0.0, query.iter().map(|q| f64::from(*q)).collect::<Vec<_>>()),
            Some(basis) => {
                let vectors = basis.vectors.chunks_exact(dim).zip(basis.steps);
                let of_component = |(v, step): (&[i8], &f32)| {
                    product(&mut v.iter().map(|v| f64::from(*v))) * f64::from(*step)
                };
                (product(&mut basis.mean.iter().map(|v| v.to_f64())), vectors.map(of_component).collect())
            }
        }
    }

    /// Returns the components of a Gaussian with evidence: its centroid's and its residual's.
    fn components(&self, index: usize) -> Vec<f64> {
        let m = self.header.n_components as usize;
        let centroid = self.row_of(index);
        let step = f64::from(self.header.centroid_step);
        let mut components: Vec<f64> =
            self.centroids[centroid * m..][..m].iter().map(|c| f64::from(*c) * step).collect();
        if let Some(residuals) = &self.residuals {
            let scale = f64::from(residuals.residual_scales[centroid]);
            for subspace in 0..residuals.subspace_starts.len() - 1 {
                let of_subspace = residuals.subspace_starts[subspace] as usize
                    ..residuals.subspace_starts[subspace + 1] as usize;
                let codeword = residuals.code(index, subspace) * of_subspace.len();
                let codeword =
                    &residuals.codewords[CODEWORDS * of_subspace.start + codeword..][..of_subspace.len()];
                components[of_subspace].iter_mut().zip(codeword).for_each(|(c, w)| *c += scale * w.to_f64());
            }
        }
        components
    }

    pub(crate) fn combine(&self, components: &[f64], out: &mut [f64]) {
        let Some(basis) = &self.basis else {
            out.copy_from_slice(components);
            return;
        };
        out.iter_mut().zip(basis.mean).for_each(|(o, v)| *o = v.to_f64());
        for ((component, vector), step) in
            components.iter().zip(basis.vectors.chunks_exact(out.len())).zip(basis.steps)
        {
            let scale = component * f64::from(*step);
            out.iter_mut().zip(vector).for_each(|(o, v)| *o += scale * f64::from(*v));
        }
    }
}

/// Rounds values to 8 bits with a common step, which is returned with them.
pub fn quantise(values: &[f32]) -> (Vec<i8>, f32) {
    let largest = values.iter().fold(0.0f32, |most, v| most.max(v.abs()));
    let step = largest / 127.0;
    let round = |v: &f32| if step > 0.0 { (v / step).round() as i8 } else { 0 };
    (values.iter().map(round).collect(), step)
}

/// A checked shard's header and where its columns lie; pair it with the bytes by [`ShardLayout::view`].
#[derive(Clone, Debug)]
pub struct ShardLayout {
    /// The fixed part.
    pub header: ShardHeader,
    positions: Range<usize>,
    centroid_starts: Range<usize>,
    centroids: Range<usize>,
    radii: Range<usize>,
    basis: Option<[Range<usize>; 3]>,
    residuals: Option<[Range<usize>; 5]>,
    exact: Option<[Range<usize>; 2]>,
    fine: Option<(ScoreErrors, [Range<usize>; 3])>,
    objects: Option<ObjectsLayout>,
}

impl ShardLayout {
    /// Returns the objects of the bytes that were checked, where the shard has them.
    ///
    /// # Panics
    /// As [`ShardLayout::view`]; the address must be 8-byte aligned.
    pub fn objects<'a>(&self, bytes: &'a [u8]) -> Option<Objects<'a>> {
        self.objects.as_ref().map(|objects| objects.view(bytes))
    }

    /// Returns the columns of the bytes that were checked.
    ///
    /// # Panics
    /// If `bytes` are other than those checked (shorter), or do not start at a 4-byte aligned address
    /// (mapped files and [`container::AlignedBytes`] do).
    pub fn view<'a>(&self, bytes: &'a [u8]) -> ShardView<'a> {
        fn cast<'a, T: Pod>(bytes: &'a [u8], range: &Range<usize>) -> &'a [T] {
            bytemuck::cast_slice(&bytes[range.clone()])
        }
        ShardView {
            header: self.header,
            positions: match is_packed(&self.header) {
                true => Positions::Packed(cast(bytes, &self.positions)),
                false => Positions::Wide(cast(bytes, &self.positions)),
            },
            centroid_starts: cast(bytes, &self.centroid_starts),
            centroids: cast(bytes, &self.centroids),
            radii: cast(bytes, &self.radii),
            basis: self.basis.as_ref().map(|[mean, vectors, steps]| Basis {
                mean: cast(bytes, mean),
                vectors: cast(bytes, vectors),
                steps: cast(bytes, steps),
            }),
            residuals: self.residuals.as_ref().map(
                |[subspace_starts, codewords, residual_scales, residual_norms, codes]| Residuals {
                    subspace_starts: cast(bytes, subspace_starts),
                    codewords: cast(bytes, codewords),
                    residual_scales: cast(bytes, residual_scales),
                    residual_norms: cast(bytes, residual_norms),
                    codes: &bytes[codes.clone()],
                },
            ),
            exact: self.exact.as_ref().map(|[indices, embeddings]| ExactColumns {
                input_indices: cast(bytes, indices),
                embeddings: cast(bytes, embeddings),
                fine: self.fine.as_ref().map(|(errors, [steps, scales, values])| Fine {
                    errors: *errors,
                    steps: cast(bytes, steps),
                    scales: cast(bytes, scales),
                    values: cast(bytes, values),
                }),
            }),
        }
    }
}

fn is_packed(header: &ShardHeader) -> bool {
    header.position_bits[..3] != [16; 3]
}

#[cfg(test)]
mod tests;
