//! Every binary of this file is the target of its own name.

#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    slag_fuzz::run(env!("CARGO_BIN_NAME"), data);
});
