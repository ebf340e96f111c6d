//! The working memory of an encode: the flag's value, or half of the free memory.

use std::fs;

use slag_common::ByteSize;

const MIN_MEMORY_BYTES: u64 = 64 << 20;
/// For machines that do not report free memory.
const UNKNOWN_MEMORY_BYTES: u64 = 2 << 30;

pub(crate) fn parse_memory(text: &str) -> Result<u64, String> {
    let ByteSize(bytes) = text.parse()?;
    if bytes < MIN_MEMORY_BYTES {
        return Err(format!("{text:?} is too little; expected at least 64MiB"));
    }
    Ok(bytes)
}

pub(crate) fn default_memory_bytes() -> u64 {
    half_of(free_memory_bytes())
}

/// Free memory, within the control group's limit (version 2) if any; `None` on machines that do not report it.
pub fn free_memory_bytes() -> Option<u64> {
    let read = |path: &str| fs::read_to_string(path).ok();
    let group = |file: &str| read(&format!("/sys/fs/cgroup/memory.{file}"))?.trim().parse::<u64>().ok();
    free(read("/proc/meminfo").as_deref(), group("max"), group("current"))
}

/// `meminfo`: content of `/proc/meminfo`; the others: the control group's limit and use.
fn free(meminfo: Option<&str>, max_bytes: Option<u64>, current_bytes: Option<u64>) -> Option<u64> {
    let available = |text: &str| {
        let line = text.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
        line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()?.checked_mul(1024)
    };
    let of_machine = meminfo.and_then(available);
    let of_group = max_bytes.map(|max| max.saturating_sub(current_bytes.unwrap_or(0)));
    of_machine.into_iter().chain(of_group).min()
}

fn half_of(free: Option<u64>) -> u64 {
    free.map_or(UNKNOWN_MEMORY_BYTES, |bytes| (bytes / 2).max(MIN_MEMORY_BYTES))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_is_half_of_what_is_free() {
        let meminfo =
            "MemTotal:       24683964 kB\nMemFree: 1 kB\nMemAvailable:   20971520 kB\nBuffers: 5 kB\n";
        let half = |meminfo, max, current| half_of(free(meminfo, max, current));
        assert_eq!(half(Some(meminfo), None, None), 10 << 30);
        assert_eq!(half(Some(meminfo), Some(8 << 30), Some(2 << 30)), 3 << 30);
        assert_eq!(half(Some(meminfo), Some(1 << 30), Some(2 << 30)), 64 << 20);
        assert_eq!(half(Some("MemAvailable: many"), None, None), 2 << 30);
        assert_eq!(half(None, None, None), 2 << 30);
    }
}
