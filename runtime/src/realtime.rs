//! What the machine grants to nodes that ask for it: SCHED_FIFO priority, cores of their own, pages that stay in memory. Where
//! it is not permitted, one warning says what to do, and the node runs without.

use nix::sched::{CpuSet, sched_setaffinity};
use nix::sys::mman::{MlockAllFlags, mlockall};
use nix::unistd::Pid;
use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

/// How late a timer may fire, ns. Linux lets it be 50 µs late otherwise.
const TIMER_SLACK_NS: u64 = 1_000;

/// Gives the calling thread its priority (1 to 99) and its cores. What was refused is returned as warnings.
pub fn apply_to_thread(node: &str, priority: Option<u8>, cpus: &[usize]) -> Vec<String> {
    let mut warnings = Vec::new();
    if let Err(error) = nix::sys::prctl::set_timerslack(TIMER_SLACK_NS) {
        tracing::debug!("timer slack: {error}");
    }
    if let Some(priority) = priority
        && let Err(reason) = set_fifo(priority)
    {
        warnings.push(format!(
            "node `{node}`: priority {priority} (SCHED_FIFO) is not permitted: {reason}; it runs without. Allow it with \
             `ulimit -r {priority}`, for good with the line `@realtime - rtprio {priority}` in \
             /etc/security/limits.d/realtime.conf (then log in again), or with \
             `sudo setcap cap_sys_nice+ep $(which carril)`"
        ));
    }
    if !cpus.is_empty()
        && let Err(reason) = set_cpus(cpus)
    {
        let online = std::thread::available_parallelism().map_or(1, usize::from);
        warnings.push(format!(
            "node `{node}`: cpus {cpus:?}: {reason}; it runs on any core. This machine offers {online} (0 to {})",
            online - 1
        ));
    }
    warnings
}

fn set_fifo(priority: u8) -> Result<(), String> {
    let value = ThreadPriorityValue::try_from(priority)?;
    let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Crossplatform(value), policy)
        .map_err(|error| format!("{error:?}"))
}

fn set_cpus(cpus: &[usize]) -> Result<(), String> {
    let mut set = CpuSet::new();
    for &cpu in cpus {
        set.set(cpu).map_err(|_| format!("there is no core {cpu}"))?;
    }
    sched_setaffinity(Pid::from_raw(0), &set).map_err(|error| error.desc().to_owned())
}

/// Keeps all pages of this process in memory. Returns a warning when that is refused.
pub fn lock_memory(process: &str) -> Option<String> {
    let error = mlockall(MlockAllFlags::MCL_CURRENT | MlockAllFlags::MCL_FUTURE).err()?;
    Some(format!(
        "process `{process}`: its memory cannot be locked: {}; pages may be swapped out. Allow it with `ulimit -l unlimited`, \
         for good with the line `@realtime - memlock unlimited` in /etc/security/limits.d/realtime.conf, or with \
         `sudo setcap cap_ipc_lock+ep $(which carril)`",
        error.desc()
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_refused_comes_back_with_a_remedy() {
        let warnings = std::thread::spawn(|| apply_to_thread("lane", None, &[1000])).join().expect("no panic");
        assert_eq!(warnings.len(), 1, "core 1000 is refused: {warnings:?}");
        assert!(warnings[0].contains("`lane`") && warnings[0].contains("[1000]"), "it says who and what: {warnings:?}");
    }

    #[test]
    fn a_core_that_exists_is_granted() {
        let warnings = std::thread::spawn(|| {
            let allowed = nix::sched::sched_getaffinity(Pid::from_raw(0)).expect("the kernel knows the affinity");
            let core = (0..CpuSet::count()).find(|&cpu| allowed.is_set(cpu).unwrap_or(false)).expect("a core");
            let warnings = apply_to_thread("lane", None, &[core]);
            let after = nix::sched::sched_getaffinity(Pid::from_raw(0)).expect("the kernel knows the affinity");
            let cores: Vec<_> = (0..CpuSet::count()).filter(|&cpu| after.is_set(cpu).unwrap_or(false)).collect();
            assert_eq!(cores, [core], "only that core");
            warnings
        });
        assert!(warnings.join().expect("no panic").is_empty(), "nothing was refused");
    }
}
