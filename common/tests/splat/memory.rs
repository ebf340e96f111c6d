//! Peak memory while ten million Gaussians are read.

use super::*;
use std::io::BufWriter;

fn peak_rss_bytes() -> usize {
    let status = std::fs::read_to_string("/proc/self/status").expect("Linux");
    let line = status.lines().find(|line| line.starts_with("VmHWM:")).expect("VmHWM");
    line.split_whitespace().nth(1).expect("a number").parse::<usize>().expect("a number") * 1024
}

#[test]
#[ignore = "writes 680 MB and measures the process: run it alone with --ignored"]
fn ten_million_gaussians_stay_within_twice_their_size() {
    const COUNT: usize = 10_000_000;
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("large.ply");
    let mut file = BufWriter::new(std::fs::File::create(&path).expect("creates"));
    let names = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3";
    let properties: String = names.split(' ').map(|name| format!("property float {name}\n")).collect();
    write!(file, "ply\nformat binary_little_endian 1.0\nelement vertex {COUNT}\n{properties}end_header\n")
        .expect("writes");
    for i in 0..COUNT {
        let row: [f32; 17] = std::array::from_fn(|j| (i * 17 + j) as f32 * 1e-9);
        row.iter().try_for_each(|value| file.write_all(&value.to_le_bytes())).expect("writes");
    }
    file.flush().expect("writes");
    drop(file);

    let before = peak_rss_bytes();
    let start = std::time::Instant::now();
    let gaussians = read(&path, &ReadOptions::default()).unwrap_or_else(|error| panic!("{error}"));
    let seconds = start.elapsed().as_secs_f64();
    let (peak, decoded) = (peak_rss_bytes(), Gaussians::decoded_bytes(COUNT, 0));
    println!("{COUNT} Gaussians in {seconds:.1} s: peak {peak} bytes ({before} before), decoded {decoded}");
    assert_eq!(gaussians.len(), COUNT);
    assert!(peak < 2 * decoded, "{peak} bytes");
}
