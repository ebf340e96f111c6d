//! All end-to-end tests in one program: it is linked once, and its tests share what they encode.

mod api;
mod cases;
mod doc_tests;
mod doors;
mod drone;
mod export;
mod fleet;
mod found;
mod fuzz;
mod house;
mod keys;
mod kill;
mod layers;
mod locate;
mod manual;
mod page;
mod poison;
mod python_tuf;
mod repair;
mod room;
mod sam;
mod store_bytes;
mod text_model;
mod tls;
mod versions;
mod views;

#[global_allocator]
static ALLOCATOR: slag_test_support::CountingAllocator = slag_test_support::CountingAllocator;
