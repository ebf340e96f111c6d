//! The attacks that TUF names, each against a client that has updated once, and other people's TUF.

mod attacks;

mod recovery;
mod repo;
