//! The calls to Linux for which there is no safe function: a TUN device, a command inside a namespace, a thread's niceness.

use std::ffi::CString;
use std::fs::{File, OpenOptions};
use std::io;
use std::os::fd::AsRawFd;
use std::os::unix::fs::OpenOptionsExt;
use std::os::unix::process::CommandExt;
use std::process::Command;
use std::sync::Arc;

use nix::libc;
use nix::sched::{CloneFlags, setns, unshare};

/// The device through which packets enter and leave user space.
pub const TUN_PATH: &str = "/dev/net/tun";

/// Makes the TUN device `name` in the namespace of the calling thread. It is there for as long as the file is open. One read is
/// one IP packet, one write too; a read returns `WouldBlock` where there is none.
#[allow(unsafe_code, reason = "nix has no TUNSETIFF without its feature `ioctl`, which nothing else here needs")]
pub fn open_tun(name: &str) -> io::Result<File> {
    let file = OpenOptions::new().read(true).write(true).custom_flags(libc::O_NONBLOCK).open(TUN_PATH)?;
    // SAFETY: all zeros is a valid `ifreq`: bytes, numbers and null pointers.
    let mut request: libc::ifreq = unsafe { std::mem::zeroed() };
    assert!(name.len() < request.ifr_name.len(), "`{name}` is too long for a network device");
    for (to, from) in request.ifr_name.iter_mut().zip(name.bytes()) {
        *to = from as libc::c_char;
    }
    request.ifr_ifru.ifru_flags = (libc::IFF_TUN | libc::IFF_NO_PI) as libc::c_short;
    // SAFETY: the file is open, and TUNSETIFF reads and writes one `ifreq`, which outlives the call.
    let result = unsafe { libc::ioctl(file.as_raw_fd(), libc::TUNSETIFF, &raw mut request) };
    if result < 0 { Err(io::Error::last_os_error()) } else { Ok(file) }
}

/// Lets the command begin inside a network namespace, with `shared_memory` in the place of `/dev/shm` where it is given: two
/// hosts on one machine would otherwise pass messages through memory, around the link.
#[allow(unsafe_code, reason = "nothing safe runs between fork and exec; what runs there makes system calls only")]
pub fn begin_inside(command: &mut Command, namespace: Arc<File>, shared_memory: Option<CString>) {
    let begin = move || {
        setns(&*namespace, CloneFlags::CLONE_NEWNET)?;
        if let Some(folder) = &shared_memory {
            unshare(CloneFlags::CLONE_NEWNS)?;
            // SAFETY: the strings end with 0 and outlive the calls; a null source, type or data is allowed with these flags.
            unsafe {
                mount(std::ptr::null(), c"/".as_ptr(), libc::MS_REC | libc::MS_SLAVE)?;
                mount(folder.as_ptr(), c"/dev/shm".as_ptr(), libc::MS_BIND)?;
            }
        }
        Ok(())
    };
    // SAFETY: system calls are async-signal-safe, and nothing here allocates: the strings were made before.
    unsafe {
        command.pre_exec(begin);
    }
}

/// # Safety
///
/// `source` is null or a string that ends with 0, `target` is such a string.
#[allow(unsafe_code, reason = "nix has no mount without its feature `mount`, which nothing else here needs")]
unsafe fn mount(source: *const libc::c_char, target: *const libc::c_char, flags: libc::c_ulong) -> io::Result<()> {
    // SAFETY: as the caller promises.
    let result = unsafe { libc::mount(source, target, std::ptr::null(), flags, std::ptr::null()) };
    if result < 0 { Err(io::Error::last_os_error()) } else { Ok(()) }
}

/// Lets the calling thread run before others, so that the link keeps its times while the programs on it are busy: in real time,
/// at the lowest priority there is; where that is refused, as in some containers, at a better niceness.
#[allow(unsafe_code, reason = "nix has neither sched_setscheduler nor setpriority")]
pub fn hurry() {
    const NICENESS: libc::c_int = -15;
    // SAFETY: all zeros is a valid `sched_param`: numbers.
    let mut parameters: libc::sched_param = unsafe { std::mem::zeroed() };
    parameters.sched_priority = 1;
    // SAFETY: the structure outlives the call; on Linux, 0 is the calling thread.
    if unsafe { libc::sched_setscheduler(0, libc::SCHED_RR, &raw const parameters) } < 0 {
        // Where this is refused too, the link works, only later; the counters say how late.
        // SAFETY: it only takes numbers.
        unsafe { libc::setpriority(libc::PRIO_PROCESS, 0, NICENESS) };
    }
}
