use super::*;

fn unpacked(indices: &[u32]) -> Vec<u32> {
    let column = IndexColumn::pack(indices);
    assert_eq!(column.view().check(indices.len()), Ok(()), "{indices:?}");
    (0..indices.len()).map(|at| column.view().get(at)).collect()
}

/// Oracle: the indices themselves, in every width, so that some cross words.
#[test]
fn every_width_comes_back() {
    let mut random = slag_math::random::Random::new(5);
    for width in 0..=32u32 {
        for n in [1usize, 2, 31, 32, 33, 200] {
            let most = (1u64 << width) - 1;
            let least = (u64::from(u32::MAX) - most).min(random.bits() >> 40) as u32;
            let mut indices: Vec<u32> =
                (0..n).map(|_| least + (u64::from(random.bits() as u32) & most) as u32).collect();
            // The range is reached, so that the width is the intended one.
            indices[0] = least;
            indices[n - 1] = least + if n > 1 { most as u32 } else { 0 };
            assert_eq!(unpacked(&indices), indices, "{width} bits");
            let column = IndexColumn::pack(&indices);
            assert_eq!(column.header.width_bits, if n > 1 { width } else { 0 });
            assert_eq!(Some(column.words.len()), n_words(n, column.header.width_bits));
        }
    }
    assert!(unpacked(&[]).is_empty());
}

/// By hand: 5 + 0b101, 5 + 0b000, 5 + 0b011 in three bits each.
#[test]
fn the_first_index_lies_in_the_lowest_bits() {
    let column = IndexColumn::pack(&[10, 5, 8]);
    let expected =
        IndexColumn { header: IndicesHeader { least: 5, width_bits: 3 }, words: vec![0b011_000_101] };
    assert_eq!(column, expected);
}

#[test]
fn indices_past_the_largest_are_refused() {
    let header = IndicesHeader { least: u32::MAX - 2, width_bits: 2 };
    let check = |words: &[u32]| PackedIndices { header, words }.check(3);
    assert_eq!(check(&[0b10_10_01]), Ok(()));
    assert!(check(&[0b10_11_01]).is_err_and(|e| e.contains("Gaussian 1")));
    assert!(check(&[0b01_10_10_01]).is_err_and(|e| e.contains("not zero")));
}
