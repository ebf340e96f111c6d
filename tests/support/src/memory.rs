//! An allocator that counts, for tests that bound the memory of a reader of foreign bytes.
#![expect(unsafe_code, reason = "a global allocator is unsafe to implement")]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

/// The system's allocator, counting bytes per thread. Test crates make it their `#[global_allocator]`.
pub struct CountingAllocator;

thread_local! {
    static LIVE_BYTES: Cell<isize> = const { Cell::new(0) };
    static PEAK_BYTES: Cell<isize> = const { Cell::new(0) };
    static LARGEST_BYTES: Cell<usize> = const { Cell::new(0) };
}

fn took(bytes: usize) {
    let live = LIVE_BYTES.get() + bytes as isize;
    LIVE_BYTES.set(live);
    PEAK_BYTES.set(PEAK_BYTES.get().max(live));
    LARGEST_BYTES.set(LARGEST_BYTES.get().max(bytes));
}

// SAFETY: every call is forwarded unchanged to the system's allocator.
unsafe impl GlobalAlloc for CountingAllocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        took(layout.size());
        // SAFETY: the caller meets the system allocator's requirements.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        took(layout.size());
        // SAFETY: the caller meets the system allocator's requirements.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        LIVE_BYTES.set(LIVE_BYTES.get() - layout.size() as isize);
        // SAFETY: the caller meets the system allocator's requirements.
        unsafe { System.dealloc(pointer, layout) }
    }
}

/// Memory that work took on its thread, bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Taken {
    pub peak_bytes: usize,
    /// Largest single request.
    pub largest_bytes: usize,
}

/// Returns the result of `work` and its memory, if [`CountingAllocator`] is the global allocator.
pub fn memory_of<T>(work: impl FnOnce() -> T) -> (T, Taken) {
    let before = LIVE_BYTES.get();
    PEAK_BYTES.set(before);
    LARGEST_BYTES.set(0);
    let result = work();
    let peak_bytes = (PEAK_BYTES.get() - before) as usize;
    (result, Taken { peak_bytes, largest_bytes: LARGEST_BYTES.get() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[global_allocator]
    static ALLOCATOR: CountingAllocator = CountingAllocator;

    #[test]
    fn peak_and_largest_are_counted() {
        let (kept, taken) = memory_of(|| {
            drop(vec![1u8; 3000]);
            (vec![1u8; 1000], vec![0u8; 1500])
        });
        assert_eq!(taken, Taken { peak_bytes: 3000, largest_bytes: 3000 });
        let (_, taken) = memory_of(|| drop(kept));
        assert_eq!(taken, Taken { peak_bytes: 0, largest_bytes: 0 });
        let (_, taken) = memory_of(|| (vec![1u8; 1000], vec![0u8; 1500]));
        assert_eq!(taken, Taken { peak_bytes: 2500, largest_bytes: 1500 });
    }
}
