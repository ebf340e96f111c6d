//! The memory that this process really has, as Linux counts it.

/// Peak memory of the process so far; `None` on other systems than Linux.
pub fn peak_bytes() -> Option<u64> {
    status_bytes("VmHWM:")
}

fn status_bytes(name: &str) -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix(name))?;
    let kib: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kib * 1024)
}

/// Returns freed memory to the system. glibc keeps what threads freed for these threads alone, so that the memory of
/// phases would add up.
pub fn give_back() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    trim();
}

#[cfg(all(target_os = "linux", target_env = "gnu"))]
#[expect(unsafe_code, reason = "glibc offers it as a C function alone")]
fn trim() {
    // SAFETY: it takes a number, locks each arena of the allocator, and touches pages that lie in free chunks
    // alone, so that no value can change. It may be called at any time from any thread.
    unsafe { libc::malloc_trim(0) };
}

#[cfg(all(test, target_os = "linux", target_env = "gnu"))]
mod tests {
    use super::*;

    /// A thread frees 64 MB in pieces that the allocator keeps, between pieces that live on: given back, they are no
    /// longer held, and the others are intact. Several attempts, because other tests of this process may allocate
    /// meanwhile.
    #[test]
    fn freed_memory_is_given_back_and_the_rest_is_kept() {
        let is_less_held = || {
            let kept: Vec<Vec<u8>> = std::thread::spawn(|| {
                let pieces: Vec<Vec<u8>> = (0..2048u32).map(|i| vec![(i % 251) as u8; 1 << 15]).collect();
                // Drops all but one of 64.
                pieces.into_iter().enumerate().filter(|(i, _)| i % 64 == 0).map(|(_, piece)| piece).collect()
            })
            .join()
            .expect("no panic");
            let before = status_bytes("VmRSS:").expect("Linux");
            give_back();
            let after = status_bytes("VmRSS:").expect("Linux");
            for (i, piece) in kept.iter().enumerate() {
                assert!(piece.iter().all(|x| *x == (64 * i % 251) as u8), "piece {i}");
            }
            // The kernel counts the peak in batches of pages per processor.
            assert!(peak_bytes().expect("Linux") + (4 << 20) >= before);
            after + (32 << 20) < before
        };
        assert!((0..10).any(|_| is_less_held()));
    }
}
