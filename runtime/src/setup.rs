//! What an operator may use while it is built.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use carril_messages::PayloadMut;

use crate::clock::Clock;
use crate::lines::MemoryLines;

/// Wakes a node from any thread: its `step` then runs with [`Trigger::Wake`](crate::Trigger::Wake). Wakes coalesce.
#[derive(Clone)]
pub struct Waker(Arc<dyn Fn() + Send + Sync>);

impl Waker {
    /// From what wakes.
    pub fn new(wake: impl Fn() + Send + Sync + 'static) -> Self {
        Self(Arc::new(wake))
    }

    /// Wakes the node.
    pub fn wake(&self) {
        (self.0)();
    }
}

/// Where large payloads get their memory: the heap, or memory shared between processes.
pub trait BufferPool: Send + Sync {
    /// `len` bytes to write to. Their content is undefined, but initialised. Falls back to the heap when the pool is empty.
    fn buffer(&self, len: usize) -> PayloadMut;
}

/// Memory on the heap.
#[derive(Clone, Copy, Debug, Default)]
pub struct HeapPool;

impl BufferPool for HeapPool {
    fn buffer(&self, len: usize) -> PayloadMut {
        PayloadMut::heap(len)
    }
}

/// What an operator may use while it is built. Drivers keep parts of it for their threads.
#[derive(Clone)]
pub struct Setup {
    /// Name of the robot.
    pub robot: String,
    /// Name of the node.
    pub node: String,
    /// Folder of the graph file; relative paths in configurations begin there.
    pub base_dir: PathBuf,
    /// Folder of this run, for sockets and simulated devices. `None` in lockstep.
    pub run_dir: Option<PathBuf>,
    /// Seed of the run; the same seed gives the same bytes in lockstep.
    pub seed: u64,
    /// Wakes this node from a driver's thread.
    pub waker: Waker,
    /// The clock for stamping what a driver's thread captures. Steps get their time from their context instead.
    pub clock: Arc<dyn Clock>,
    /// Memory for images.
    pub buffers: Arc<dyn BufferPool>,
    /// In lockstep, the serial lines that exist in memory. `None` when running live: lines are devices.
    pub memory_lines: Option<MemoryLines>,
}

impl Setup {
    /// A path from a configuration.
    pub fn path(&self, path: &str) -> PathBuf {
        self.base_dir.join(Path::new(path))
    }

    /// A setup for tests of an operator on its own: heap memory, a clock that stands at zero, memory lines.
    pub fn for_tests(node: &str) -> Self {
        Self {
            robot: "test".into(),
            node: node.into(),
            base_dir: PathBuf::from("."),
            run_dir: None,
            seed: 1,
            waker: Waker::new(|| ()),
            clock: Arc::new(crate::clock::VirtualClock::default()),
            buffers: Arc::new(HeapPool),
            memory_lines: Some(MemoryLines::default()),
        }
    }
}
