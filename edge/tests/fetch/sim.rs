//! Storage that can lose power: unsynced data is lost, torn or kept, at random.

use super::*;
use std::io;

use slag_edge::store::files::Stat;
use slag_edge::store::mmap::FileBytes;

/// Smallest piece of unsynced content lost or kept on its own.
const SECTOR_BYTES: usize = 128;

#[derive(Clone, Default)]
struct Inode {
    live: Vec<u8>,
    durable: Vec<u8>,
}

/// An unsynced change of a folder: a link, or a removal.
#[derive(Clone)]
struct Change {
    path: PathBuf,
    /// Absent: the path is removed.
    inode: Option<usize>,
    /// The link of the same rename; renaming never loses a file.
    after: Option<usize>,
}

#[derive(Clone, Default)]
struct Disk {
    inodes: Vec<Inode>,
    live: BTreeMap<PathBuf, usize>,
    durable: BTreeMap<PathBuf, usize>,
    pending: BTreeMap<usize, Change>,
    n_changes: usize,
    n_steps: u64,
    cut_at: Option<u64>,
    fail_at: Option<u64>,
    is_cut: bool,
    capacity_bytes: Option<u64>,
    /// Whether free space is reported as unknown.
    hides_free_space: bool,
    random: u64,
}

#[derive(Default)]
pub struct SimFiles(Mutex<Disk>);

impl SimFiles {
    /// Returns a copy that loses power at a step (counted from 1), which may still take effect. A copy of storage
    /// that lost power is in the state left by a killed process: with everything that happened, synced or not.
    pub fn fork(&self, cut_at: Option<u64>, seed: u64) -> Self {
        let state = self.0.lock().expect("sound").clone();
        Self(Mutex::new(Disk { n_steps: 0, cut_at, is_cut: false, random: seed, ..state }))
    }

    /// Makes one later step fail once with an I/O error; it may still take effect.
    pub fn fail_at(&self, step: Option<u64>) {
        self.0.lock().expect("sound").fail_at = step;
    }

    pub fn n_steps(&self) -> u64 {
        self.0.lock().expect("sound").n_steps
    }

    /// Limits the bytes of all files. Without showing it: other programs use the space up meanwhile.
    pub fn limit(&self, capacity_bytes: Option<u64>, is_shown: bool) {
        let mut state = self.0.lock().expect("sound");
        (state.capacity_bytes, state.hides_free_space) = (capacity_bytes, !is_shown);
    }

    /// Flips a bit of a file, if it exists: the medium rots.
    pub fn flip(&self, path: &Path, random: &mut Random) {
        let mut state = self.0.lock().expect("sound");
        let Some(inode) = state.live.get(path).copied() else { return };
        let Inode { live, durable } = &mut state.inodes[inode];
        if !live.is_empty() {
            let (at, bit) = (random.below(live.len() as u64) as usize, 1 << random.below(8));
            live[at] ^= bit;
            durable.get_mut(at).into_iter().for_each(|byte| *byte ^= bit);
        }
    }

    pub fn used_bytes(&self) -> u64 {
        self.0.lock().expect("sound").used_bytes()
    }

    pub fn after_power_cut(&self, seed: u64) -> Self {
        let mut random = Random::new(seed);
        let mut state = self.0.lock().expect("sound").clone();
        let mut kept_changes = BTreeSet::new();
        let pending = std::mem::take(&mut state.pending);
        for (number, change) in &pending {
            let may_follow = |link: usize| !pending.contains_key(&link) || kept_changes.contains(&link);
            let is_possible = change.after.is_none_or(may_follow);
            if is_possible && random.below(2) == 0 {
                kept_changes.insert(*number);
                state.apply(change);
            }
        }
        for inode in &mut state.inodes {
            if inode.live != inode.durable {
                inode.durable = torn(inode, &mut random);
            }
            inode.live = inode.durable.clone();
        }
        state.live = state.durable.clone();
        Self(Mutex::new(Disk { is_cut: false, cut_at: None, fail_at: None, n_steps: 0, ..state }))
    }
}

/// Returns one possible content of an unsynced file.
fn torn(inode: &Inode, random: &mut Random) -> Vec<u8> {
    let len = match random.below(3) {
        0 => inode.durable.len(),
        1 => inode.live.len(),
        _ => random.below(inode.live.len().max(inode.durable.len()) as u64 + 1) as usize,
    };
    let mut out = vec![0; len];
    for start in (0..len).step_by(SECTOR_BYTES) {
        let range = start..(start + SECTOR_BYTES).min(len);
        let source = match random.below(3) {
            0 => &inode.durable,
            1 => &inode.live,
            _ => continue,
        };
        for at in range {
            out[at] = source.get(at).copied().unwrap_or(0);
        }
    }
    out
}

impl Disk {
    fn free_bytes(&self) -> u64 {
        self.capacity_bytes.map_or(u64::MAX, |capacity| capacity.saturating_sub(self.used_bytes()))
    }

    fn used_bytes(&self) -> u64 {
        self.live.values().map(|inode| self.inodes[*inode].live.len() as u64).sum()
    }

    fn change(&mut self, path: &Path, inode: Option<usize>, after: Option<usize>) -> usize {
        self.n_changes += 1;
        self.pending.insert(self.n_changes, Change { path: path.to_owned(), inode, after });
        self.n_changes
    }

    fn apply(&mut self, change: &Change) {
        match change.inode {
            Some(inode) => drop(self.durable.insert(change.path.clone(), inode)),
            None => drop(self.durable.remove(&change.path)),
        }
    }

    fn inode(&self, path: &Path) -> io::Result<usize> {
        let missing = || io::Error::new(io::ErrorKind::NotFound, format!("{} is not there", path.display()));
        self.live.get(path).copied().ok_or_else(missing)
    }

    fn check_power(&self) -> io::Result<()> {
        if self.is_cut { Err(io::Error::other("the power is cut")) } else { Ok(()) }
    }
}

impl SimFiles {
    /// Takes one step, unless the power is cut; the step of the cut may still take effect.
    fn step(&self, work: impl FnOnce(&mut Disk) -> io::Result<()>) -> io::Result<()> {
        let mut state = self.0.lock().expect("sound");
        state.check_power()?;
        state.n_steps += 1;
        let is_cut = state.cut_at == Some(state.n_steps);
        if !is_cut && state.fail_at != Some(state.n_steps) {
            return work(&mut state);
        }
        if Random::new(state.random ^ u64::from(!is_cut)).below(2) == 0 {
            work(&mut state)?;
        }
        state.is_cut = is_cut;
        state.check_power()?;
        Err(io::Error::other("the medium fails"))
    }

    fn look<T>(&self, work: impl FnOnce(&Disk) -> io::Result<T>) -> io::Result<T> {
        let state = self.0.lock().expect("sound");
        state.check_power()?;
        work(&state)
    }
}

impl Files for SimFiles {
    fn create_dir(&self, _dir: &Path) -> io::Result<()> {
        self.look(|_| Ok(()))
    }

    fn write_from(&self, path: &Path, offset_bytes: u64, bytes: &[u8]) -> io::Result<()> {
        self.step(|state| {
            let inode = match state.live.get(path) {
                Some(inode) => *inode,
                None => {
                    state.inodes.push(Inode::default());
                    let inode = state.inodes.len() - 1;
                    state.live.insert(path.to_owned(), inode);
                    state.change(path, Some(inode), None);
                    inode
                }
            };
            state.inodes[inode].live.resize(offset_bytes as usize, 0);
            let n_fitting = bytes.len().min(state.free_bytes() as usize);
            state.inodes[inode].live.extend_from_slice(&bytes[..n_fitting]);
            if n_fitting < bytes.len() {
                return Err(io::Error::new(io::ErrorKind::StorageFull, "no space left"));
            }
            Ok(())
        })
    }

    fn sync(&self, path: &Path) -> io::Result<()> {
        self.step(|state| {
            let inode = state.inode(path)?;
            state.inodes[inode].durable = state.inodes[inode].live.clone();
            Ok(())
        })
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        self.step(|state| {
            let inode = state.inode(from)?;
            state.live.remove(from);
            state.live.insert(to.to_owned(), inode);
            let link = state.change(to, Some(inode), None);
            state.change(from, None, Some(link));
            Ok(())
        })
    }

    fn sync_dir(&self, dir: &Path) -> io::Result<()> {
        self.step(|state| {
            let all = state.pending.clone();
            for (number, change) in all.iter().filter(|(_, change)| change.path.parent() == Some(dir)) {
                if !change.after.is_some_and(|link| state.pending.contains_key(&link)) {
                    state.apply(change);
                    state.pending.remove(number);
                }
            }
            Ok(())
        })
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        self.step(|state| {
            if state.live.remove(path).is_some() {
                state.change(path, None, None);
            }
            Ok(())
        })
    }

    fn list(&self, dir: &Path) -> io::Result<Vec<String>> {
        self.look(|state| {
            let here = state.live.keys().filter(|path| path.parent() == Some(dir));
            Ok(here.filter_map(|path| Some(path.file_name()?.to_str()?.to_owned())).collect())
        })
    }

    fn read(&self, path: &Path, max_bytes: u64) -> io::Result<AlignedBytes> {
        self.look(|state| {
            let bytes = &state.inodes[state.inode(path)?].live;
            if bytes.len() as u64 > max_bytes {
                return Err(io::Error::new(io::ErrorKind::InvalidData, "the file is too long"));
            }
            Ok(AlignedBytes::copy_of(bytes))
        })
    }

    fn map(&self, path: &Path) -> io::Result<FileBytes> {
        self.look(|state| Ok(FileBytes::Read(AlignedBytes::copy_of(&state.inodes[state.inode(path)?].live))))
    }

    fn stat(&self, path: &Path) -> io::Result<Option<Stat>> {
        self.look(|state| {
            let stat = |inode: &usize| Stat {
                len_bytes: state.inodes[*inode].live.len() as u64,
                modified: None,
                inode: *inode as u64,
            };
            Ok(state.live.get(path).map(stat))
        })
    }

    fn free_bytes(&self, _dir: &Path) -> io::Result<u64> {
        self.look(|state| Ok(if state.hides_free_space { u64::MAX } else { state.free_bytes() }))
    }
}
