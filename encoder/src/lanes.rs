//! Things that are lent to one piece of work each, such as the opened models of GPUs: each GPU has a few, its lanes,
//! and work goes to the GPU with the most free ones.
//!
//! While one lane of a GPU computes, another copies. The load of a GPU is the time in which any of its lanes is at
//! work.

use std::ops::{Deref, DerefMut};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use serde::Serialize;

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct GpuLoad {
    /// The GPU, as CUDA numbers it.
    pub gpu: u32,
    /// Lanes: models that may be at work at once.
    pub n_lanes: usize,
    pub busy_secs: f64,
}

/// Things by GPU, each for one piece of work at a time.
#[derive(Debug)]
pub struct Lanes<T> {
    gpus: Mutex<Vec<Gpu<T>>>,
    freed: Condvar,
}

#[derive(Debug)]
struct Gpu<T> {
    number: u32,
    n_lanes: usize,
    free: Vec<T>,
    is_left_out: bool,
    busy_since: Option<Instant>,
    busy: Duration,
}

/// A lane in use; dropping it frees it.
#[derive(Debug)]
pub struct Lane<'a, T> {
    lanes: &'a Lanes<T>,
    gpu: usize,
    /// `Some` until dropped.
    held: Option<T>,
}

impl<T> Lanes<T> {
    pub fn new(gpus: impl IntoIterator<Item = (u32, Vec<T>)>) -> Self {
        let gpu = |(number, free): (u32, Vec<T>)| Gpu {
            number,
            n_lanes: free.len(),
            free,
            is_left_out: false,
            busy_since: None,
            busy: Duration::ZERO,
        };
        let gpus = gpus.into_iter().map(gpu).collect();
        Self { gpus: Mutex::new(gpus), freed: Condvar::new() }
    }

    fn gpus(&self) -> MutexGuard<'_, Vec<Gpu<T>>> {
        self.gpus.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub fn len(&self) -> usize {
        self.gpus().iter().map(|gpu| gpu.n_lanes).sum()
    }

    /// Takes a free lane, or waits for one.
    pub fn take(&self) -> Lane<'_, T> {
        self.take_if_any().expect("a lane")
    }

    /// Takes a free lane, or waits for one; `None` once all GPUs are left out.
    pub fn take_if_any(&self) -> Option<Lane<'_, T>> {
        let mut gpus = self.gpus();
        while gpus.iter().any(|gpu| !gpu.is_left_out) {
            match self.take_of(&mut gpus) {
                Some(lane) => return Some(lane),
                None => gpus = self.freed.wait(gpus).unwrap_or_else(PoisonError::into_inner),
            }
        }
        None
    }

    fn take_of(&self, gpus: &mut [Gpu<T>]) -> Option<Lane<'_, T>> {
        // Reversed, because `max_by_key` returns the last of equals.
        let (gpu, of_gpu) = gpus.iter_mut().enumerate().rev().max_by_key(|(_, gpu)| gpu.free.len())?;
        let held = of_gpu.free.pop()?;
        of_gpu.busy_since.get_or_insert_with(Instant::now);
        Some(Lane { lanes: self, gpu, held: Some(held) })
    }

    pub fn loads(&self) -> Vec<GpuLoad> {
        let load = |gpu: &Gpu<T>| GpuLoad {
            gpu: gpu.number,
            n_lanes: gpu.n_lanes,
            busy_secs: (gpu.busy + gpu.busy_since.map_or(Duration::ZERO, |since| since.elapsed()))
                .as_secs_f64(),
        };
        self.gpus().iter().map(load).collect()
    }
}

impl<T> Lane<'_, T> {
    pub fn gpu(&self) -> u32 {
        self.lanes.gpus()[self.gpu].number
    }

    /// Leaves the lane's GPU out from now on; the first time, returns how many others remain.
    pub fn leave_out(self) -> Option<usize> {
        let mut gpus = self.lanes.gpus();
        gpus[self.gpu].free.clear();
        let was_left_out = std::mem::replace(&mut gpus[self.gpu].is_left_out, true);
        let n_others = gpus.iter().filter(|gpu| !gpu.is_left_out).count();
        drop(gpus);
        // Waiting threads must see that there may be no GPU.
        self.lanes.freed.notify_all();
        (!was_left_out).then_some(n_others)
    }
}

impl<T> Deref for Lane<'_, T> {
    type Target = T;

    fn deref(&self) -> &T {
        self.held.as_ref().expect("held until it is dropped")
    }
}

impl<T> DerefMut for Lane<'_, T> {
    fn deref_mut(&mut self) -> &mut T {
        self.held.as_mut().expect("held until it is dropped")
    }
}

impl<T> Drop for Lane<'_, T> {
    fn drop(&mut self) {
        let mut gpus = self.lanes.gpus();
        let gpu = &mut gpus[self.gpu];
        gpu.free.extend(self.held.take().filter(|_| !gpu.is_left_out));
        if gpu.free.len() == gpu.n_lanes {
            gpu.busy += gpu.busy_since.take().map_or(Duration::ZERO, |since| since.elapsed());
        }
        drop(gpus);
        self.lanes.freed.notify_one();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two GPUs of two lanes: work alternates, a fifth piece waits, and a GPU is busy while any lane is.
    #[test]
    fn work_goes_to_the_gpu_with_the_most_free_lanes() {
        let lanes = Lanes::new([(4, vec!['a', 'b']), (7, vec!['c', 'd'])]);
        assert_eq!(lanes.len(), 4);
        let mut held: Vec<_> = (0..4).map(|_| lanes.take()).collect();
        assert_eq!(held.iter().map(Lane::gpu).collect::<Vec<_>>(), [4, 7, 4, 7]);
        assert!(lanes.take_of(&mut lanes.gpus()).is_none());
        std::thread::scope(|scope| {
            let waiting = scope.spawn(|| lanes.take().gpu());
            held.remove(1);
            assert_eq!(waiting.join().expect("no panic"), 7);
        });
        // GPU 4 stays busy, GPU 7 has one busy lane.
        let before = lanes.loads();
        held.retain(|lane| lane.gpu() == 4);
        let [four, seven] = &lanes.loads()[..] else { panic!("two GPUs") };
        assert!(four.busy_secs > before[0].busy_secs && four.n_lanes == 2 && seven.busy_secs > 0.0);
        assert_eq!(lanes.loads()[1], *seven, "its time stands still");
        held.truncate(1);
        assert_eq!(held.pop().and_then(Lane::leave_out), Some(1));
        assert_eq!((lanes.take().gpu(), lanes.take().leave_out()), (7, Some(0)));
        assert!(lanes.take_if_any().is_none());
    }
}
