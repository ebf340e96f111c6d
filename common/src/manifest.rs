//! The manifest: the signed list of a scene's shards.
//!
//! On disk and on the wire it is one ASCII line, `slag-manifest 1 ed25519 PUBLIC_KEY SIGNATURE\n`
//! (hex), and then the JSON text that the signature covers byte for byte, so that no two readers can
//! disagree on what was signed. Same scene, same JSON: fields in declaration order, no spaces.

use std::collections::BTreeMap;

use ed25519_dalek::{Signature, Signer, SigningKey, VerifyingKey};
use serde::{Deserialize, Serialize};

use crate::frames::{Aabb, GeoReference};
use crate::hash::Hash32;
use crate::shard::{Profile, ScoreErrors};

/// Version of the manifest format that is written and read.
pub const VERSION: u32 = 1;
/// A longer manifest is refused unread (a cell takes about 600 bytes: room for 100,000 cells).
pub const MAX_BYTES: u64 = 64 << 20;

/// A signed list of the shards of one generation of a scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// Format version.
    pub version: u32,
    /// Name of the scene.
    pub scene: String,
    /// Counts encodes of this scene; a robot never goes back to a smaller one.
    pub generation: u64,
    /// Seconds since 1970 when it was signed.
    pub created_unix_secs: u64,
    /// Seconds since 1970 after which robots refuse it; absent: never.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub expires_unix_secs: Option<u64>,
    /// The public key that signs later generations: who accepts this manifest's key accepts that one
    /// too, and, once it has signed a manifest, only that one; absent: no change of keys is under way.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub next_key: Option<Hash32>,
    /// Whether a world unit is a metre.
    pub metric: bool,
    /// Where the world frame lies on the earth, if known.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub geo_reference: Option<GeoReference>,
    /// The encoder whose space the embeddings live in.
    pub encoder: EncoderRecord,
    /// Gaussians in all cells.
    pub n_gaussians: u64,
    /// Those without an embedding: never seen, or seen under no mask.
    pub n_without_evidence: u64,
    /// Gaussians of the input that no cell holds, since a field was not finite or not valid.
    pub n_rejected: u64,
    /// The cells, by id, ascending.
    pub cells: Vec<CellRecord>,
}

/// The encoder that made a scene's embeddings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EncoderRecord {
    /// Its name, for people.
    pub name: String,
    /// Its identity: a digest of name, dimension and the SHA-256 of its model files.
    pub id: Hash32,
    /// Components of an embedding.
    pub dim: u32,
    /// Cosine at or above which a Gaussian matches, unless the query or the calibration says otherwise.
    pub default_threshold: f32,
    /// How texts score in this scene; there where the model states no threshold.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub calibration: Option<Calibration>,
}

/// How a bank of texts scores in a scene: nearly all pairs of text and Gaussian do not belong together, so
/// this is what no match looks like in this scene, with this encoder.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Calibration {
    /// Mean of the scores of all pairs.
    pub score_mean: f32,
    /// Their standard deviation, over all pairs (not within a text).
    pub score_spread: f32,
}

/// A cell: a piece of space and its shards.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CellRecord {
    /// The cell.
    pub cell_id: u32,
    /// Box around the extents of its Gaussians, world frame.
    pub bounds: Aabb,
    /// Gaussians.
    pub n_gaussians: u32,
    /// Its shards, one a profile.
    pub shards: BTreeMap<Profile, ShardRecord>,
}

/// A shard: an immutable file named by its hash.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ShardRecord {
    /// BLAKE3 of the file.
    pub hash: Hash32,
    /// Length of the file.
    pub len_bytes: u64,
    /// Codebook rows.
    pub n_centroids: u32,
    /// Largest distance of an embedding from what the profile decodes: no score is off by more.
    pub score_error_bound: f32,
    /// Errors of scores, measured over a bank of texts.
    pub score_errors: ScoreErrors,
    /// Largest error of a position, world units.
    pub position_error: f64,
}

/// Why a manifest is refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ManifestError {
    /// Longer than [`MAX_BYTES`].
    #[error("the manifest has {len_bytes} bytes, the limit is {MAX_BYTES}; this is no manifest of ours")]
    TooLong {
        /// Length found.
        len_bytes: u64,
    },
    /// The first line is not as it should be.
    #[error(
        "line 1: {what}; expected `slag-manifest 1 ed25519 PUBLIC_KEY SIGNATURE`; is this the address of a slag-encoder store?"
    )]
    Envelope {
        /// What was found.
        what: String,
    },
    /// Signed by a key that is not accepted.
    #[error(
        "the manifest is signed by key {found}, accepted is {accepted}; if the change is meant, accept the new key explicitly"
    )]
    UnknownKey {
        /// The key found.
        found: Hash32,
        /// The keys accepted, separated by spaces.
        accepted: String,
    },
    /// The bytes are not what was signed.
    #[error("the signature does not fit the manifest's bytes: it was changed on the way; fetch again")]
    Signature,
    /// The signed text is not a manifest.
    #[error("the signed text is not a manifest of version {VERSION}: {what}")]
    Content {
        /// What is wrong.
        what: String,
    },
    /// Past its expiry.
    #[error(
        "the manifest expired at {expired_unix_secs} s since 1970, it is {now_unix_secs} now; have the scene published again, or check the clock"
    )]
    Expired {
        /// Expiry.
        expired_unix_secs: u64,
        /// The clock.
        now_unix_secs: u64,
    },
}

/// Whose manifests are accepted.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum TrustedKeys {
    /// Only these.
    Only(Vec<Hash32>),
    /// Whichever key signed it: for the first contact, whose key is then kept.
    FirstContact,
}

impl Manifest {
    /// Returns the signed form.
    pub fn sign(&self, key: &SigningKey) -> Vec<u8> {
        let json = serde_json::to_vec(self).expect("a manifest has no map with other keys than strings");
        let signature = key.sign(&json);
        let public = hex::encode(key.verifying_key().to_bytes());
        let mut out =
            format!("slag-manifest {VERSION} ed25519 {public} {}\n", hex::encode(signature.to_bytes()))
                .into_bytes();
        out.extend(json);
        out
    }

    /// Checks a signed manifest and returns it with the key that signed it.
    ///
    /// # Errors
    /// [`ManifestError`]; expiry is checked by [`Manifest::check_expiry`].
    pub fn verify(bytes: &[u8], trusted: &TrustedKeys) -> Result<(Self, Hash32), ManifestError> {
        if bytes.len() as u64 > MAX_BYTES {
            return Err(ManifestError::TooLong { len_bytes: bytes.len() as u64 });
        }
        let envelope = |what: &str| ManifestError::Envelope { what: what.to_owned() };
        let end = bytes
            .iter()
            .take(512)
            .position(|b| *b == b'\n')
            .ok_or_else(|| envelope("no line end in 512 bytes"))?;
        let line = std::str::from_utf8(&bytes[..end]).map_err(|_| envelope("not ASCII"))?;
        let words: Vec<&str> = line.split(' ').collect();
        let ["slag-manifest", version, "ed25519", public, signature] = words[..] else {
            return Err(envelope(&format!("found {:?}", line.chars().take(40).collect::<String>())));
        };
        if version != VERSION.to_string() {
            return Err(envelope(&format!("version {version:?}")));
        }
        let public: Hash32 = public.parse().map_err(|_| envelope("the public key is not 64 hex digits"))?;
        let mut signature_bytes = [0; 64];
        hex::decode_to_slice(signature, &mut signature_bytes)
            .map_err(|_| envelope("the signature is not 128 hex digits"))?;
        if let TrustedKeys::Only(keys) = trusted
            && !keys.contains(&public)
        {
            let accepted = keys.iter().map(Hash32::to_string).collect::<Vec<_>>().join(" ");
            return Err(ManifestError::UnknownKey { found: public, accepted });
        }
        let key = VerifyingKey::from_bytes(&public.0)
            .map_err(|_| envelope("the public key is no Ed25519 point"))?;
        let json = &bytes[end + 1..];
        // Strict: small-order keys, for which several signatures hold, are refused (RFC 8032, 5.1.7).
        key.verify_strict(json, &Signature::from_bytes(&signature_bytes))
            .map_err(|_| ManifestError::Signature)?;
        let manifest: Self =
            serde_json::from_slice(json).map_err(|e| ManifestError::Content { what: e.to_string() })?;
        manifest.check_content()?;
        if manifest.next_key == Some(public) {
            return Err(ManifestError::Content { what: "the next key is the one that signs".into() });
        }
        Ok((manifest, public))
    }

    /// Checks what a signature does not: a key holder's program may be wrong too.
    fn check_content(&self) -> Result<(), ManifestError> {
        let refuse = |what: String| Err(ManifestError::Content { what });
        if self.version != VERSION {
            return refuse(format!("version {}", self.version));
        }
        if self.encoder.dim == 0 || self.encoder.dim as usize > crate::shard::MAX_DIM {
            return refuse(format!("embeddings of {} components", self.encoder.dim));
        }
        if self.cells.windows(2).any(|pair| pair[0].cell_id >= pair[1].cell_id) {
            return refuse("cell ids do not ascend".into());
        }
        for cell in &self.cells {
            let Aabb { min, max } = cell.bounds;
            if !(min.is_finite() && max.is_finite() && min.cmple(max).all()) {
                return refuse(format!("cell {}: box {min}..{max}", cell.cell_id));
            }
        }
        Ok(())
    }

    /// Checks the expiry against a clock.
    ///
    /// # Errors
    /// [`ManifestError::Expired`].
    pub fn check_expiry(&self, now_unix_secs: u64) -> Result<(), ManifestError> {
        match self.expires_unix_secs {
            Some(expired_unix_secs) if expired_unix_secs < now_unix_secs => {
                Err(ManifestError::Expired { expired_unix_secs, now_unix_secs })
            }
            _ => Ok(()),
        }
    }
}

/// An R-tree over the boxes of a manifest's cells.
pub struct CellIndex {
    tree: rstar::RTree<IndexedCell>,
}

struct IndexedCell {
    position: usize,
    bounds: Aabb,
}

impl rstar::RTreeObject for IndexedCell {
    type Envelope = rstar::AABB<[f64; 3]>;

    fn envelope(&self) -> Self::Envelope {
        rstar::AABB::from_corners(self.bounds.min.to_array(), self.bounds.max.to_array())
    }
}

impl rstar::PointDistance for IndexedCell {
    fn distance_2(&self, point: &[f64; 3]) -> f64 {
        self.bounds.distance_to((*point).into()).powi(2)
    }
}

impl CellIndex {
    /// Builds the index of some cells' boxes (bulk load, O(n log n)).
    pub fn new<'a>(cells: impl IntoIterator<Item = &'a CellRecord>) -> Self {
        let indexed = cells
            .into_iter()
            .enumerate()
            .map(|(position, cell)| IndexedCell { position, bounds: cell.bounds });
        Self { tree: rstar::RTree::bulk_load(indexed.collect()) }
    }

    /// Returns the positions, ascending, of the cells whose box comes within a radius of a point.
    pub fn within(&self, centre_in_world: glam::DVec3, radius: f64) -> Vec<usize> {
        let found = self.tree.locate_within_distance(centre_in_world.to_array(), radius * radius);
        let mut positions: Vec<usize> = found.map(|cell| cell.position).collect();
        positions.sort_unstable();
        positions
    }
}

/// Makes a fresh signing key from the system's randomness.
pub fn generate_key() -> SigningKey {
    SigningKey::generate(&mut rand_core::OsRng)
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use proptest::prelude::*;

    use super::*;

    fn manifest(n_cells: u32) -> Manifest {
        Manifest {
            version: VERSION,
            scene: "yard \"7\"\n".into(),
            generation: 3,
            created_unix_secs: 1_700_000_000,
            expires_unix_secs: Some(1_800_000_000),
            next_key: Some(Hash32([5; 32])),
            metric: true,
            geo_reference: None,
            encoder: EncoderRecord {
                name: "e".into(),
                id: Hash32([7; 32]),
                dim: 512,
                default_threshold: 0.1,
                calibration: None,
            },
            n_gaussians: 10,
            n_without_evidence: 1,
            n_rejected: 0,
            cells: (0..n_cells)
                .map(|cell_id| {
                    let min = DVec3::new(f64::from(cell_id) / 3.0, 0.1, -1e6);
                    let record = ShardRecord {
                        hash: Hash32::of(b"x"),
                        len_bytes: 9,
                        n_centroids: 2,
                        score_error_bound: 0.1,
                        score_errors: ScoreErrors::default(),
                        position_error: 1e-3,
                    };
                    let shards = BTreeMap::from([(Profile::Compact, record)]);
                    CellRecord {
                        cell_id,
                        bounds: Aabb { min, max: min + DVec3::ONE },
                        n_gaussians: 5,
                        shards,
                    }
                })
                .collect(),
        }
    }

    #[test]
    fn signed_round_trip_and_refusals() {
        let (key, other) = (generate_key(), generate_key());
        let public = Hash32(key.verifying_key().to_bytes());
        let bytes = manifest(4).sign(&key);
        let (back, signer) = Manifest::verify(&bytes, &TrustedKeys::FirstContact).expect("valid");
        assert_eq!((back, signer), (manifest(4), public));
        assert!(Manifest::verify(&bytes, &TrustedKeys::Only(vec![public])).is_ok());
        let stranger = TrustedKeys::Only(vec![Hash32(other.verifying_key().to_bytes())]);
        assert!(matches!(Manifest::verify(&bytes, &stranger), Err(ManifestError::UnknownKey { .. })));
        assert!(
            manifest(1).check_expiry(1_800_000_001).is_err()
                && manifest(1).check_expiry(1_799_999_999).is_ok()
        );
        let unordered = Manifest { cells: manifest(4).cells.into_iter().rev().collect(), ..manifest(0) };
        assert!(matches!(
            Manifest::verify(&unordered.sign(&key), &TrustedKeys::FirstContact),
            Err(ManifestError::Content { .. })
        ));
        let own_successor = Manifest { next_key: Some(public), ..manifest(1) };
        assert!(matches!(
            Manifest::verify(&own_successor.sign(&key), &TrustedKeys::FirstContact),
            Err(ManifestError::Content { .. })
        ));
    }

    #[test]
    fn every_flipped_bit_is_refused() {
        let key = generate_key();
        let trusted = TrustedKeys::Only(vec![Hash32(key.verifying_key().to_bytes())]);
        let bytes = manifest(1).sign(&key);
        for at in 0..bytes.len() {
            for bit in 0..8 {
                let mut flipped = bytes.clone();
                flipped[at] ^= 1 << bit;
                // A hex digit of the signature in upper case is the same signature.
                let same = flipped.eq_ignore_ascii_case(&bytes) && at < 256;
                assert!(Manifest::verify(&flipped, &trusted).is_err() || same, "byte {at} bit {bit}");
            }
        }
    }

    proptest! {
        /// Oracle: brute force over the boxes.
        #[test]
        fn radius_search_equals_brute_force(
            boxes in prop::collection::vec((prop::array::uniform3(-50.0..50.0f64), prop::array::uniform3(0.0..20.0f64)), 0..60),
            centre in prop::array::uniform3(-60.0..60.0f64), radius in 0.0..50.0f64,
        ) {
            let template = manifest(1).cells.remove(0);
            let cells: Vec<CellRecord> = boxes.iter().map(|(min, size)| {
                let min = DVec3::from(*min);
                CellRecord { bounds: Aabb { min, max: min + DVec3::from(*size) }, ..template.clone() }
            }).collect();
            let expected: Vec<usize> = (0..cells.len()).filter(|i| {
                let nearest = DVec3::from(centre).clamp(cells[*i].bounds.min, cells[*i].bounds.max);
                nearest.distance_squared(centre.into()) <= radius * radius
            }).collect();
            prop_assert_eq!(CellIndex::new(&cells).within(centre.into(), radius), expected);
        }
    }
}
