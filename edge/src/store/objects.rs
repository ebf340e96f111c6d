//! Index of the objects on board: the shards and Gaussians of each, built once when a generation is opened.
//!
//! An object in several cells is stored in all of their shards. Vectors, records and run ends stay there; the index
//! takes 4 bytes for a run of Gaussians and about 30 for an object.

use std::ops::Range;

use slag_common::objects::{NO_OBJECT, Objects};

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Part {
    pub shard: u32,
    pub number: u32,
}

/// The objects of a generation, by id, ascending.
#[derive(Debug, Default)]
pub struct ObjectIndex {
    /// `[n + 1]`: starts of the objects' parts.
    starts: Vec<u32>,
    parts: Vec<Part>,
    shards: Vec<ShardIndex>,
}

#[derive(Debug, Default)]
struct ShardIndex {
    /// Objects without a part in an earlier shard: their number in this shard, ascending, and the object.
    first: Vec<(u32, u32)>,
    /// `[n + 1]`: starts of the objects' runs.
    run_starts: Vec<u32>,
    /// Runs, ordered by object number.
    runs: Vec<u32>,
}

impl ObjectIndex {
    /// Builds the index. `objects`: those of the generation's shards, in their order.
    pub fn new(objects: &[Option<Objects<'_>>]) -> Self {
        let mut index = Self::default();
        let mut parts: Vec<(u64, Part)> = Vec::new();
        for (shard, objects) in (0..).zip(objects) {
            let ids = objects.iter().flat_map(|objects| objects.records).map(|record| record.id);
            parts.extend((0..).zip(ids).map(|(number, id)| (id, Part { shard, number })));
            index.shards.push(objects.as_ref().map(ShardIndex::new).unwrap_or_default());
        }
        parts.sort_unstable();
        index.starts.push(0);
        for (object, of_object) in (0..).zip(parts.chunk_by(|a, b| a.0 == b.0)) {
            let Part { shard, number } = of_object[0].1;
            index.shards[shard as usize].first.push((number, object));
            index.parts.extend(of_object.iter().map(|(_, part)| *part));
            index.starts.push(index.parts.len() as u32);
        }
        index.shards.iter_mut().for_each(|shard| shard.first.sort_unstable());
        index
    }

    pub fn len(&self) -> usize {
        self.starts.len().saturating_sub(1)
    }

    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    pub fn parts(&self, object: usize) -> &[Part] {
        &self.parts[self.starts[object] as usize..self.starts[object + 1] as usize]
    }

    /// Returns the objects with their first part in this shard (each is in exactly one shard's list): their number
    /// there, ascending, and the object.
    pub(crate) fn first_in(&self, shard: usize) -> &[(u32, u32)] {
        &self.shards[shard].first
    }

    /// Returns a part's runs of Gaussians, ascending. `objects`: those of its shard.
    pub fn runs<'a>(&'a self, part: Part, objects: &'a Objects<'_>) -> impl Iterator<Item = Range<u32>> + 'a {
        let ShardIndex { run_starts, runs, .. } = &self.shards[part.shard as usize];
        let of_part =
            run_starts[part.number as usize] as usize..run_starts[part.number as usize + 1] as usize;
        runs[of_part].iter().map(|run| objects.run(*run as usize))
    }
}

impl ShardIndex {
    /// Sorts the runs by object; `first` is filled in later.
    fn new(objects: &Objects<'_>) -> Self {
        let numbers = || (0u32..).zip(objects.run_objects).filter(|(_, number)| **number != NO_OBJECT);
        let mut run_starts = vec![0u32; objects.records.len() + 1];
        numbers().for_each(|(_, number)| run_starts[usize::from(*number) + 1] += 1);
        (1..run_starts.len()).for_each(|at| run_starts[at] += run_starts[at - 1]);
        let mut next = run_starts.clone();
        let mut runs = vec![0; numbers().count()];
        for (run, number) in numbers() {
            let next = &mut next[usize::from(*number)];
            runs[*next as usize] = run;
            *next += 1;
        }
        Self { first: Vec::new(), run_starts, runs }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use slag_common::objects::{ObjectRecord, ObjectsHeader};

    use super::*;
    use slag_math::random::Random;

    /// Oracle: every run of every shard, one by one.
    #[test]
    fn objects_have_the_runs_that_name_them() {
        let mut random = Random::new(71);
        for n_shards in [0, 1, 4] {
            let columns: Vec<(Vec<ObjectRecord>, Vec<u32>, Vec<u16>)> = (0..n_shards)
                .map(|shard| {
                    // The third shard has no objects; ids repeat, even within a shard.
                    let n = if shard == 2 { 0 } else { 1 + random.bits() % 30 };
                    let record = |id| ObjectRecord { id, ..bytemuck::Zeroable::zeroed() };
                    let records = (0..n).map(|_| record(random.bits() % 40)).collect();
                    let numbers = (0..200).map(|_| random.bits() % (n + 1));
                    let numbers = numbers.map(|o| if o == n { NO_OBJECT } else { o as u16 }).collect();
                    let ends = (0..200).scan(0, |end, _| {
                        *end += 1 + random.bits() as u32 % 9;
                        Some(*end)
                    });
                    (records, ends.collect(), numbers)
                })
                .collect();
            let objects = columns.iter().map(|(records, run_ends, run_objects)| Objects {
                header: ObjectsHeader { n_objects: records.len() as u32, ..bytemuck::Zeroable::zeroed() },
                records,
                vectors: &[],
                steps: &[],
                run_ends,
                run_objects,
                photos: b"",
                thumbnails: None,
            });
            let objects: Vec<_> =
                objects.map(|objects| Some(objects).filter(|objects| !objects.records.is_empty())).collect();
            let mut expected: BTreeMap<u64, Vec<(u32, Range<u32>)>> = BTreeMap::new();
            let mut first: BTreeMap<u64, Part> = BTreeMap::new();
            for (shard, objects) in (0..).zip(&objects) {
                for number in 0..objects.as_ref().map_or(0, |objects| objects.records.len()) {
                    let objects = objects.as_ref().expect("has objects");
                    let id = objects.records[number].id;
                    first.entry(id).or_insert(Part { shard, number: number as u32 });
                    let of_number = objects.runs().filter(|(_, object)| *object == Some(number));
                    expected.entry(id).or_default().extend(of_number.map(|(run, _)| (shard, run)));
                }
            }
            let index = ObjectIndex::new(&objects);
            assert_eq!((index.len(), index.is_empty()), (expected.len(), expected.is_empty()));
            for ((object, runs), first) in expected.values().enumerate().zip(first.values()) {
                let of_part = |part: &Part| {
                    let (shard, part) = (part.shard, *part);
                    let objects = objects[shard as usize].as_ref().expect("has objects");
                    index.runs(part, objects).map(move |run| (shard, run)).collect::<Vec<_>>()
                };
                assert_eq!(index.parts(object)[0], *first);
                assert_eq!(&index.parts(object).iter().flat_map(of_part).collect::<Vec<_>>(), runs);
                assert!(index.first_in(first.shard as usize).contains(&(first.number, object as u32)));
            }
            let n_first: usize = (0..objects.len()).map(|shard| index.first_in(shard).len()).sum();
            assert_eq!(n_first, index.len());
        }
    }
}
