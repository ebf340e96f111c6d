use super::*;
use slag_common::container::AlignedBytes;

/// Two views' regions under masks of three levels, whose vectors are axes and diagonals.
fn table() -> RegionTable {
    let mut table = RegionTable::new(4);
    let vectors = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.6, 0.8, 0.0], [0.0, 0.0, 0.0, 1.0]];
    table.append(vectors.as_flattened(), [&[0u32, 1][..], &[0, 2, 3], &[3]].into_iter());
    table.set_levels(vec![0, 1, 1, 2]);
    table.set_mask_weights(&[1.0, 0.5, 2.0, 0.25]);
    table
}

/// Three Gaussians: under both views, under one, under none.
fn field(table: &RegionTable) -> CellField {
    let mut field = CellField {
        input_indices: vec![0, 1, 2],
        starts: vec![0, 2, 3, 3],
        regions: vec![0, 1, 2],
        weights: vec![3.0, 1.0, 5.0],
        total_weights: Vec::new(),
        mean_lengths: Vec::new(),
    };
    for k in 0..3 {
        let (mut total, mut sum) = (0.0f32, [0.0f32; 4]);
        for (mask, count) in
            field.entries(k).flat_map(|(r, w)| table.masks_of(r).map(move |(m, s)| (m, w * s)))
        {
            total += count;
            sum.iter_mut().zip(table.mask_vectors().get(mask as usize)).for_each(|(s, v)| *s += count * v);
        }
        let length = dot(&sum, &sum).sqrt();
        field.total_weights.push(total);
        field.mean_lengths.push(if total > 0.0 { length / total } else { 0.0 });
    }
    field
}

/// Oracle: each level's sum by its definition, in f64.
#[test]
fn the_best_of_the_levels_is_that_of_the_definition() {
    let table = table();
    let field = field(&table);
    let lengths = lengths(&field, &table);
    for query in [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.5, 0.5, 0.5, 0.5], [0.0, -0.6, -0.8, 0.0]] {
        let found = best_of_levels(&field, &table.scores_by_level(&query), &lengths, 3);
        for (k, found) in found.iter().enumerate().take(2) {
            let mut contributions = [[0.0f64; 4]; 3];
            for (region, weight) in field.entries(k) {
                for (mask, share) in table.masks_of(region) {
                    let vector = table.mask_vectors().get(mask as usize);
                    for (sum, v) in contributions[table.level_of(mask)].iter_mut().zip(vector) {
                        *sum += f64::from(weight) * f64::from(share) * f64::from(*v);
                    }
                }
            }
            let length = |s: &[f64; 4]| s.iter().map(|c| c * c).sum::<f64>().sqrt();
            let longest = contributions.iter().map(length).fold(0.0, f64::max);
            let known = contributions.iter().filter(|s| length(s) >= 0.1 * longest);
            let cosine =
                |s: &[f64; 4]| s.iter().zip(query).map(|(c, q)| c * f64::from(q)).sum::<f64>() / length(s);
            let expected = known.map(cosine).fold(f64::MIN, f64::max);
            assert!((f64::from(*found) - expected).abs() < 1e-6, "{k}: {found} {expected}");
        }
        assert!(found[2].is_nan(), "no contributions, no score");
    }
    // By hand: the third level's 0.25 of a sum of 4 long is less than a tenth, and does not answer.
    let unsaid = best_of_levels(&field, &table.scores_by_level(&[0.0, 0.0, 0.0, 1.0]), &lengths, 3);
    assert_eq!(unsaid[0], 0.0);
    assert_eq!(unsaid[1], 1.0);
}

/// Masks of one level: the plain field.
#[test]
fn one_level_is_the_plain_score() {
    let mut table = table();
    table.set_levels(vec![0; 4]);
    let field = field(&table);
    let query = [0.5, 0.5, 0.5, 0.5];
    let found = best_of_levels(&field, &table.scores_by_level(&query), &lengths(&field, &table), 1);
    for (a, b) in found.iter().zip(field.cosines(&table.scores(&query))) {
        assert!((a - b).abs() < 1e-6 || a.is_nan() && b.is_nan());
    }
}

#[test]
fn levels_are_kept_in_the_file_of_regions() {
    let table = table();
    let mut bytes = Vec::new();
    table.write(&mut bytes).expect("writes to memory");
    let bytes = AlignedBytes::copy_of(&bytes);
    assert_eq!(RegionTable::from_bytes(&bytes).expect("reads"), table);
}
