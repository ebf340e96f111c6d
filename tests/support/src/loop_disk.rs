//! A small real disk with sectors that can be broken.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::thread::sleep;
use std::time::Duration;

/// Blocks that a file's inode lists itself; an indirect block lists the others.
pub const N_DIRECT_BLOCKS: usize = 12;
pub const BLOCK_BYTES: usize = 1024;

/// An ext2 file system in a file, mounted through a loop device. Mark tests with
/// [`needs_loop_disk`](crate::needs_loop_disk).
pub struct LoopDisk {
    image: PathBuf,
    at: PathBuf,
}

impl LoopDisk {
    pub fn new(dir: &Path) -> Self {
        let disk = Self { image: dir.join("disk.img"), at: dir.join("disk") };
        fs::create_dir_all(&disk.at).expect("a folder");
        fs::File::create(&disk.image).and_then(|file| file.set_len(8 << 20)).expect("an image");
        run(Command::new("mkfs.ext2").args(["-q", "-F", "-b", "1024"]).arg(&disk.image));
        disk.mount();
        disk
    }

    pub fn path(&self) -> &Path {
        &self.at
    }

    fn mount(&self) {
        run(Command::new("mount").args(["-o", "loop,errors=continue"]).arg(&self.image).arg(&self.at));
    }

    /// A program that another test starts has all open files of this process until it begins, so it is tried again.
    fn unmount(&self) {
        let unmounts = |_: &u32| {
            sleep(Duration::from_millis(50));
            Command::new("umount").arg(&self.at).output().is_ok_and(|output| output.status.success())
        };
        if (0..100).find(unmounts).is_none() {
            run(Command::new("umount").arg(&self.at));
        }
    }

    fn debugfs(&self, request: &str) -> String {
        run(Command::new("debugfs").args(["-w", "-R", request]).arg(&self.image))
    }

    /// Moves a block of a file beyond the disk, so that reading it fails with EIO. No program may use the disk.
    pub fn break_block(&self, file: &Path, block: usize) {
        let name = file.strip_prefix(&self.at).expect("on the disk").display();
        self.unmount();
        let blocks = self.debugfs(&format!("stat {name}"));
        let indirect = blocks.split("(IND):").nth(1).expect("a file of more than 12 blocks");
        let indirect: String = indirect.chars().take_while(char::is_ascii_digit).collect();
        let offset = 4 * block.checked_sub(N_DIRECT_BLOCKS).expect("a block that an indirect block names");
        self.debugfs(&format!("zap_block -o {offset} -l 4 -p 0x7f {indirect}"));
        self.mount();
    }

    /// Breaks a file's inode, so that it can be neither examined, nor opened, nor replaced.
    pub fn break_inode(&self, file: &Path) {
        let name = file.strip_prefix(&self.at).expect("on the disk").display();
        self.unmount();
        self.debugfs(&format!("set_inode_field {name} block[3] 99999999"));
        self.mount();
    }
}

impl Drop for LoopDisk {
    fn drop(&mut self) {
        // Lazily: a program left by a failed test may use it.
        let _ = Command::new("umount").arg("-l").arg(&self.at).status();
    }
}

fn run(command: &mut Command) -> String {
    command.env("PATH", "/usr/local/sbin:/usr/sbin:/sbin:/usr/local/bin:/usr/bin:/bin");
    let output = command.output().expect("runs");
    assert!(output.status.success(), "{command:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).into_owned()
}
