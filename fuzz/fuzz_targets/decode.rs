//! Every binary built from this file runs the target of its name.

#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    slag_fuzz::run(env!("CARGO_BIN_NAME"), data);
});
