//! The full-precision field of a published generation.

use slag_common::container::{AlignedBytes, ContainerError};

use super::field::CellField;
use super::table::RegionTable;
use crate::store::{StoreError, StoreReader};

pub(crate) const EXTRA_REGIONS: &str = "regions";

/// Record of the refinements ([`super::Aggregation`], JSON); absent for the plain average.
pub(crate) const EXTRA_AGGREGATION: &str = "aggregation";

pub(crate) fn extra_field(cell_id: u32, part: u32) -> String {
    format!("field/{cell_id}/{part}")
}

pub fn read_field(
    reader: &StoreReader,
    cell_id: u32,
    n_gaussians: u32,
    n_regions: usize,
) -> Result<CellField, ReadFieldError> {
    let read_part = |part| {
        let name = extra_field(cell_id, part);
        let bytes = read_extra(reader, &name)?;
        CellField::from_bytes(&bytes, n_regions).map_err(|source| ReadFieldError::Damaged { name, source })
    };
    let mut field = read_part(0)?;
    for part in 1.. {
        if field.len() >= n_gaussians as usize {
            break;
        }
        field.append(read_part(part)?);
    }
    Ok(field)
}

pub fn read_regions(reader: &StoreReader) -> Result<RegionTable, ReadFieldError> {
    let bytes = read_extra(reader, EXTRA_REGIONS)?;
    RegionTable::from_bytes(&bytes)
        .map_err(|source| ReadFieldError::Damaged { name: EXTRA_REGIONS.into(), source })
}

fn read_extra(reader: &StoreReader, name: &str) -> Result<AlignedBytes, ReadFieldError> {
    let hash =
        reader.current().extras.get(name).ok_or_else(|| ReadFieldError::Absent { name: name.to_owned() })?;
    Ok(reader.read_object(*hash)?)
}

#[derive(Debug, thiserror::Error)]
pub enum ReadFieldError {
    #[error(transparent)]
    Store(#[from] StoreError),
    #[error("the store has no {name}: another version published it; encode again")]
    Absent { name: String },
    #[error("{name}: {source}")]
    Damaged { name: String, source: ContainerError },
}
