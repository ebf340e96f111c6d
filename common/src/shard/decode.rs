//! Decodes embeddings and scores of a shard in float64: the reference that faster code is tested against.

use half::f16;

use super::columns::{Fine, ShardView};
use super::format::CODEWORDS;
use crate::objects::{Objects, object_score};

impl ShardView<'_> {
    /// Writes the vector of a centroid to `out` (`[dim]`); the formula is in the module's documentation.
    pub fn decode_centroid(&self, centroid: usize, out: &mut [f64]) {
        self.combine(&self.components_of_centroid(centroid), out);
    }

    /// Writes the embedding of a Gaussian with evidence to `out` (`[dim]`), as accurately as this profile allows.
    pub fn decode(&self, index: usize, out: &mut [f64]) {
        let dim = self.header.dim as usize;
        if let Some(exact) = &self.exact {
            let stored = &exact.embeddings[index * dim..][..dim];
            out.iter_mut().zip(stored).for_each(|(o, v)| *o = v.to_f64());
            return;
        }
        self.combine(&self.components(index), out);
    }

    /// Writes the embedding of a Gaussian with evidence to `out` (`[dim]`), decoded from its fine residual.
    pub fn decode_fine(&self, index: usize, fine: &Fine<'_>, out: &mut [f64]) {
        let m = self.header.n_components as usize;
        let centroid = self.centroid_of(index);
        let scale = f64::from(fine.scales[centroid]);
        let mut components = self.components_of_centroid(centroid);
        let residual = fine.values[index * m..][..m].iter().zip(fine.steps);
        let residual = residual.map(|(v, step)| f64::from(*v) * f64::from(*step) * scale);
        components.iter_mut().zip(residual).for_each(|(c, r)| *c += r);
        self.combine(&components, out);
    }

    /// Scores every Gaussian with evidence for a query (`[dim]`), from embeddings as decoded by this profile.
    pub fn scores(&self, query: &[f32]) -> Vec<f64> {
        if let Some(exact) = &self.exact {
            let embeddings = exact.embeddings.chunks_exact(self.header.dim as usize);
            let score = |e: &[f16]| e.iter().zip(query).map(|(v, q)| v.to_f64() * f64::from(*q)).sum();
            return embeddings.map(score).collect();
        }
        let (offset, of_components) = self.components_of_query(query);
        let score = |index| {
            let components = self.components(index);
            offset + components.iter().zip(&of_components).map(|(c, q)| c * q).sum::<f64>()
        };
        (0..self.n_with_evidence()).map(score).collect()
    }

    /// Returns the score of every centroid for a query (`[dim]`).
    pub fn centroid_scores(&self, query: &[f32]) -> Vec<f32> {
        let (offset, of_components) = self.components_of_query(query);
        let step = f64::from(self.header.centroid_step);
        let score = |centroid: usize| {
            let components = self.centroids[centroid * of_components.len()..][..of_components.len()].iter();
            offset + step * components.zip(&of_components).map(|(c, q)| f64::from(*c) * q).sum::<f64>()
        };
        (0..self.header.n_centroids as usize).map(|centroid| score(centroid) as f32).collect()
    }

    /// Returns the products of a query (`[dim]`) with the mean and with each basis vector (`[m]`): a vector with
    /// components c has the score mean + the sum of `c[i]` times the i-th.
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

    fn components_of_centroid(&self, centroid: usize) -> Vec<f64> {
        let m = self.header.n_components as usize;
        let step = f64::from(self.header.centroid_step);
        self.centroids[centroid * m..][..m].iter().map(|c| f64::from(*c) * step).collect()
    }

    /// Returns the components of a Gaussian with evidence: centroid plus residual.
    fn components(&self, index: usize) -> Vec<f64> {
        let centroid = self.centroid_of(index);
        let mut components = self.components_of_centroid(centroid);
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

    /// Writes the vector of some components (`[m]`) to `out` (`[dim]`).
    fn combine(&self, components: &[f64], out: &mut [f64]) {
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

    /// Returns the [`object_score`] of each of the shard's objects for a query (`[dim]`).
    pub fn object_scores(&self, objects: &Objects<'_>, query: &[f32]) -> Vec<f32> {
        let (offset, of_components) = self.components_of_query(query);
        let m = of_components.len();
        let product = |(at, step): (usize, &f32)| {
            let vector = objects.vectors[at * m..][..m].iter();
            let sum: f64 = vector.zip(&of_components).map(|(v, q)| f64::from(*v) * q).sum();
            (offset + f64::from(*step) * sum) as f32
        };
        let products: Vec<f32> = objects.steps.iter().enumerate().map(product).collect();
        products.chunks_exact(objects.header.n_vectors as usize).map(object_score).collect()
    }

    /// `[n][n_vectors][dim]`.
    pub fn object_vectors(&self, objects: &Objects<'_>) -> Vec<f64> {
        let (m, dim) = (self.header.n_components as usize, self.header.dim as usize);
        let mut vectors = vec![0.0; objects.steps.len() * dim];
        for (at, (out, step)) in vectors.chunks_exact_mut(dim).zip(objects.steps).enumerate() {
            let vector = objects.vectors[at * m..][..m].iter();
            let components: Vec<f64> = vector.map(|v| f64::from(*v) * f64::from(*step)).collect();
            self.combine(&components, out);
        }
        vectors
    }
}
