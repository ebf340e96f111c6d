//! Reasons to refuse metadata, by the attack that they prevent.

#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum TufError {
    #[error("{role} metadata: {what}; check that the address or file is that of a slag-encoder store")]
    Format { role: String, what: String },
    #[error(
        "{role} metadata: {found} of its keys signed it, expected {threshold}: it was changed, or this is not the store that is trusted. If the store was made anew: `slag-edge trust add URL --sha256 HEX --replace`, with the SHA-256 of its `slag-encoder keys status`"
    )]
    Signatures { role: String, found: usize, threshold: u32 },
    #[error(
        "{role} metadata: version {offered} is offered after {seen}: an old state of the store is repeated; fetch again later, or from the store itself"
    )]
    Rollback { role: String, seen: u64, offered: u64 },
    #[error(
        "{role} metadata: version {found}, expected {expected}: files of different states are mixed; fetch again"
    )]
    Version { role: String, expected: u64, found: u64 },
    #[error("{role} metadata expired at {expired}, and it is {now} at least: the store was not refreshed, or something hides its news; run `slag-encoder {}` there, and check its clock and this machine's", if role == "root" { "keys renew" } else { "store refresh" })]
    Expired { role: String, expired: String, now: String },
    #[error("{what}: {fault}: it was changed, or files of different states are mixed; fetch again")]
    Content { what: String, fault: String },
    #[error("{what} is longer than {max_bytes} bytes, the most that is read of it")]
    TooLong { what: String, max_bytes: u64 },
    #[error(
        "{what} is missing in the store; see that the address is of `slag-encoder serve`, not of a robot, or publish the scene again"
    )]
    Missing { what: String },
    #[error("{role} metadata came out of order")]
    Order { role: String },
    #[error("more than {limit} {what} in a row; expected fewer: fetch again to go on, or check the store")]
    TooMany { what: &'static str, limit: usize },
    #[error("{what}: {fault}")]
    Source { what: String, fault: String },
}
