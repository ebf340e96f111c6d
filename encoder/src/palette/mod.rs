//! Stage 5: an error-bounded palette per cell.
//!
//! Embeddings cluster strongly, so a cell stores K rows and each Gaussian the row it belongs to.
//! Clusters are found in a random projection (Johnson and Lindenstrauss 1984: distances survive), by
//! splitting the worst cluster in two until every cluster keeps the error budget or K reaches its
//! limit, so K follows the cell's content. Row vectors and hard radii are then taken from the full
//! embeddings.

use half::f16;
use rayon::prelude::*;

/// Components of the projection in which clusters are sought: the relative error of a distance is
/// about sqrt(2 / 64) = 18 %, far below the factor between clusters worth separating.
const PROJECTED_DIM: usize = 64;
/// Rounds of 2-means when a cluster is split; the halves hardly move after the third.
const SPLIT_ROUNDS: usize = 3;
/// Rounds of k-means over all rows at the end.
const REFINE_ROUNDS: usize = 2;
/// Embeddings projected at a time by one thread.
const CHUNK: usize = 256;

/// Bytes that building a palette takes for each embedding, at most: projection, members and codes.
pub const WORKING_BYTES_PER_EMBEDDING: usize = (PROJECTED_DIM + 8) * size_of::<f32>();

/// How fine a palette is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PaletteSettings {
    /// Rows at most.
    pub max_rows: usize,
    /// Root-mean-square distance of members from their row that is good enough.
    pub max_rms: f32,
}

impl Default for PaletteSettings {
    /// 1,024 rows kept the exact field's task accuracy on a labelled house of 105,000 Gaussians; a
    /// residual of 0.1 moves a score by about 0.1 / sqrt(dim) times a few, below what masks disagree by.
    fn default() -> Self {
        Self { max_rows: 1024, max_rms: 0.1 }
    }
}

/// Rows of a cell and who belongs to them.
#[derive(Clone, Debug, PartialEq)]
pub struct Palette {
    /// `[K][dim]`.
    pub rows: Vec<f16>,
    /// `[K]`: at least the largest distance of a member's embedding from the row as stored.
    pub radii: Vec<f32>,
    /// `[n]`: row of each embedding.
    pub codes: Vec<u32>,
}

/// Embeddings that can be read several times.
pub trait EmbeddingSource: Sync {
    /// Returns the number of embeddings.
    fn len(&self) -> usize;
    /// Returns whether there are none.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }
    /// Returns the components of an embedding.
    fn dim(&self) -> usize;
    /// Writes embedding `index`, a unit vector, to `out` (`[dim]`).
    fn embedding(&self, index: usize, out: &mut [f32]);
}

/// Builds the palette of some embeddings. The result depends on them alone, not on threads.
pub fn build(source: &impl EmbeddingSource, settings: &PaletteSettings) -> Palette {
    let n = source.len();
    if n == 0 {
        return Palette { rows: Vec::new(), radii: Vec::new(), codes: Vec::new() };
    }
    let projected = Projected::new(source);
    let mut clusters = split_clusters(&projected, settings);
    let mut codes = vec![0u32; n];
    for (row, cluster) in clusters.iter().enumerate() {
        cluster.members.iter().for_each(|i| codes[*i as usize] = row as u32);
    }
    if clusters.len() > 1 {
        for _ in 0..REFINE_ROUNDS {
            codes = nearest_rows(&projected, &clusters);
            clusters = regroup(&projected, &codes, clusters.len());
        }
        let mut used: Vec<u32> = vec![u32::MAX; clusters.len()];
        let mut n_rows = 0;
        for (row, cluster) in clusters.iter().enumerate() {
            if !cluster.members.is_empty() {
                used[row] = n_rows;
                n_rows += 1;
            }
        }
        codes.iter_mut().for_each(|code| *code = used[*code as usize]);
        clusters.retain(|cluster| !cluster.members.is_empty());
    }
    let (rows, radii): (Vec<Vec<f16>>, Vec<f32>) =
        clusters.par_iter().map(|cluster| row_and_radius(source, &cluster.members)).unzip();
    Palette { rows: rows.concat(), radii, codes }
}

/// Embeddings in the projection, `[n][width]`.
struct Projected {
    width: usize,
    values: Vec<f32>,
}

impl Projected {
    fn new(source: &impl EmbeddingSource) -> Self {
        let dim = source.dim();
        let width = dim.min(PROJECTED_DIM);
        // Random signs (Achlioptas 2003), component-major so that the inner loop is contiguous.
        let signs: Vec<f32> = (0..(dim * width) as u64)
            .map(|i| if splitmix64(i) & 1 == 0 { 1.0 } else { -1.0 } / (width as f32).sqrt())
            .collect();
        let mut values = vec![0.0; source.len() * width];
        values.par_chunks_mut(CHUNK * width).enumerate().for_each(|(chunk, out)| {
            let mut embedding = vec![0.0; dim];
            for (offset, target) in out.chunks_exact_mut(width).enumerate() {
                source.embedding(chunk * CHUNK + offset, &mut embedding);
                if width == dim {
                    target.copy_from_slice(&embedding);
                    continue;
                }
                for (component, value) in embedding.iter().enumerate() {
                    let row = &signs[component * width..][..width];
                    target.iter_mut().zip(row).for_each(|(t, s)| *t += value * s);
                }
            }
        });
        Self { width, values }
    }

    fn get(&self, index: u32) -> &[f32] {
        &self.values[index as usize * self.width..][..self.width]
    }
}

struct Cluster {
    /// Ascending.
    members: Vec<u32>,
    centre: Vec<f32>,
    /// Sum of squared distances of the members from the centre.
    squared_error: f64,
}

impl Cluster {
    fn new(projected: &Projected, members: Vec<u32>) -> Self {
        let mut sum = vec![0.0f64; projected.width];
        for i in &members {
            sum.iter_mut().zip(projected.get(*i)).for_each(|(s, v)| *s += f64::from(*v));
        }
        let n = members.len().max(1) as f64;
        let centre: Vec<f32> = sum.iter().map(|s| (s / n) as f32).collect();
        let squared_error =
            members.iter().map(|i| f64::from(squared_distance(projected.get(*i), &centre))).sum();
        Self { members, centre, squared_error }
    }

    fn keeps(&self, max_rms: f32) -> bool {
        self.members.len() < 2
            || self.squared_error <= f64::from(max_rms) * f64::from(max_rms) * self.members.len() as f64
    }
}

/// Splits the cluster with the largest squared error until all keep the budget or K is reached.
fn split_clusters(projected: &Projected, settings: &PaletteSettings) -> Vec<Cluster> {
    let n = projected.values.len() / projected.width;
    let mut done = Vec::new();
    let mut open = vec![Cluster::new(projected, (0..n as u32).collect())];
    while !open.is_empty() && done.len() + open.len() < settings.max_rows {
        // Ties by position: the order of `open` depends on the data alone.
        let worst = (0..open.len())
            .max_by(|a, b| open[*a].squared_error.total_cmp(&open[*b].squared_error))
            .expect("open is not empty");
        let cluster = open.swap_remove(worst);
        if cluster.keeps(settings.max_rms) {
            done.push(cluster);
            continue;
        }
        match split_in_two(projected, &cluster) {
            Some(halves) => open.extend(halves),
            None => done.push(cluster),
        }
    }
    done.extend(open);
    done
}

/// 2-means, started from the member farthest from the centre and the one farthest from that;
/// `None` where all members coincide.
fn split_in_two(projected: &Projected, cluster: &Cluster) -> Option<[Cluster; 2]> {
    let farthest = |from: &[f32]| {
        let distance = |i: &u32| squared_distance(projected.get(*i), from);
        let best = cluster.members.par_iter().map(|i| (distance(i), *i)).reduce_with(|a, b| {
            match a.0.total_cmp(&b.0) {
                std::cmp::Ordering::Less => b,
                std::cmp::Ordering::Greater => a,
                std::cmp::Ordering::Equal => {
                    if a.1 < b.1 {
                        a
                    } else {
                        b
                    }
                }
            }
        });
        projected.get(best.expect("a cluster has members").1).to_vec()
    };
    let first = farthest(&cluster.centre);
    let second = farthest(&first);
    let mut centres = [first, second];
    let mut halves = None;
    for _ in 0..SPLIT_ROUNDS {
        let nearer_to_first = |i: &u32| {
            let value = projected.get(*i);
            squared_distance(value, &centres[0]) <= squared_distance(value, &centres[1])
        };
        let (a, b): (Vec<u32>, Vec<u32>) = cluster.members.iter().partition(|i| nearer_to_first(i));
        if a.is_empty() || b.is_empty() {
            break;
        }
        let pair = [Cluster::new(projected, a), Cluster::new(projected, b)];
        centres = [pair[0].centre.clone(), pair[1].centre.clone()];
        halves = Some(pair);
    }
    halves
}

fn nearest_rows(projected: &Projected, clusters: &[Cluster]) -> Vec<u32> {
    // ||v - c||² = ||v||² - 2 v·c + ||c||²; the first term is the same for all rows.
    let half_norms: Vec<f32> =
        clusters.iter().map(|c| crate::lift::dot(&c.centre, &c.centre) / 2.0).collect();
    projected
        .values
        .par_chunks_exact(projected.width)
        .map(|value| {
            let score = |(row, cluster): (usize, &Cluster)| {
                (crate::lift::dot(value, &cluster.centre) - half_norms[row], row as u32)
            };
            let best = clusters.iter().enumerate().map(score).reduce(|a, b| if b.0 > a.0 { b } else { a });
            best.expect("there are clusters").1
        })
        .collect()
}

fn regroup(projected: &Projected, codes: &[u32], n_rows: usize) -> Vec<Cluster> {
    let mut members = vec![Vec::new(); n_rows];
    codes.iter().enumerate().for_each(|(i, code)| members[*code as usize].push(i as u32));
    members.into_par_iter().map(|members| Cluster::new(projected, members)).collect()
}

/// Returns the mean of the members' embeddings as stored, and their largest distance from it.
fn row_and_radius(source: &impl EmbeddingSource, members: &[u32]) -> (Vec<f16>, f32) {
    let mut sum = vec![0.0f64; source.dim()];
    let mut embedding = vec![0.0; source.dim()];
    for i in members {
        source.embedding(*i as usize, &mut embedding);
        sum.iter_mut().zip(&embedding).for_each(|(s, v)| *s += f64::from(*v));
    }
    let row: Vec<f16> = sum.iter().map(|s| f16::from_f64(s / members.len() as f64)).collect();
    let decoded: Vec<f32> = row.iter().map(|c| c.to_f32()).collect();
    let mut largest = 0.0f32;
    for i in members {
        source.embedding(*i as usize, &mut embedding);
        largest = largest.max(squared_distance(&embedding, &decoded));
    }
    // Rounding of the sum over dim components stays below dim * 2^-24 of it; the bound must hold.
    let slack = 1.0 + source.dim() as f32 * f32::EPSILON;
    (row, (largest.sqrt() * slack).next_up())
}

fn squared_distance(a: &[f32], b: &[f32]) -> f32 {
    let mut lanes = [0.0f32; 16];
    let (a_blocks, a_rest) = a.as_chunks::<16>();
    let (b_blocks, b_rest) = b.as_chunks::<16>();
    for (x, y) in a_blocks.iter().zip(b_blocks) {
        for lane in 0..16 {
            let d = x[lane] - y[lane];
            lanes[lane] += d * d;
        }
    }
    let rest: f32 = a_rest.iter().zip(b_rest).map(|(x, y)| (x - y) * (x - y)).sum();
    lanes.iter().sum::<f32>() + rest
}

/// A well-mixed 64-bit value of an index (Steele, Lea and Flood 2014).
fn splitmix64(index: u64) -> u64 {
    let mut z = index.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Rows {
        dim: usize,
        values: Vec<f32>,
    }

    impl EmbeddingSource for Rows {
        fn len(&self) -> usize {
            self.values.len() / self.dim
        }
        fn dim(&self) -> usize {
            self.dim
        }
        fn embedding(&self, index: usize, out: &mut [f32]) {
            out.copy_from_slice(&self.values[index * self.dim..][..self.dim]);
        }
    }

    /// `n` unit vectors around `n_centres` random directions.
    fn clustered(n: usize, n_centres: usize, dim: usize, spread: f32) -> Rows {
        let uniform = |i: u64| (splitmix64(i) >> 40) as f32 / (1u64 << 23) as f32 - 1.0;
        let mut values = Vec::new();
        for i in 0..n {
            let centre = (splitmix64(i as u64 + 7) % n_centres as u64) * 1_000_003;
            let raw: Vec<f32> = (0..dim as u64)
                .map(|c| uniform(centre + c) + spread * uniform(1 << 40 | (i as u64) << 16 | c))
                .collect();
            let length = crate::lift::dot(&raw, &raw).sqrt();
            values.extend(raw.iter().map(|v| v / length));
        }
        Rows { dim, values }
    }

    /// Oracle: distances in float64. The radius bounds every member, and is not much larger.
    #[test]
    fn radii_bound_every_member() {
        for (dim, n) in [(512, 700), (16, 500), (3, 1)] {
            let source = clustered(n, 20, dim, 0.3);
            let palette = build(&source, &PaletteSettings { max_rows: 40, max_rms: 0.05 });
            let mut largest = vec![0.0f64; palette.radii.len()];
            for i in 0..n {
                let row = palette.codes[i] as usize;
                let d2: f64 = (0..dim)
                    .map(|c| f64::from(source.values[i * dim + c]) - palette.rows[row * dim + c].to_f64())
                    .map(|d| d * d)
                    .sum();
                largest[row] = largest[row].max(d2.sqrt());
            }
            for (radius, largest) in palette.radii.iter().zip(&largest) {
                assert!(f64::from(*radius) >= *largest, "{radius} < {largest}");
                assert!(f64::from(*radius) <= largest * 1.001 + 1e-6, "{radius} far above {largest}");
            }
        }
    }

    #[test]
    fn rows_follow_the_content_not_the_count() {
        let few = build(&clustered(5000, 4, 128, 0.02), &PaletteSettings::default());
        let many = build(&clustered(5000, 300, 128, 0.02), &PaletteSettings::default());
        assert_eq!(few.radii.len(), 4);
        // A split may cut through a cluster, which the budget then does not undo.
        assert!((300..=330).contains(&many.radii.len()), "{} rows for 300 clusters", many.radii.len());
    }

    #[test]
    fn same_bytes_for_any_number_of_threads() {
        let source = clustered(3000, 50, 64, 0.5);
        let with = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("starts");
            pool.install(|| build(&source, &PaletteSettings { max_rows: 64, max_rms: 0.01 }))
        };
        assert_eq!(with(1), with(3));
    }

    #[test]
    fn equal_embeddings_make_one_row_and_none_makes_none() {
        let same = Rows { dim: 4, values: [0.5f32; 400].to_vec() };
        assert_eq!(build(&same, &PaletteSettings { max_rows: 9, max_rms: 0.0 }).radii.len(), 1);
        let none = Rows { dim: 4, values: Vec::new() };
        assert!(build(&none, &PaletteSettings::default()).radii.is_empty());
    }
}
