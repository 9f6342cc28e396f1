//! Network namespaces with a TUN device each: made, set up, entered, removed.
//!
//! Their names hold the process that made them, so that what a killed one left behind is found and removed.

use std::ffi::CString;
use std::fs::{self, File, Permissions};
use std::io::{self, Write};
use std::net::Ipv4Addr;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::thread;

use nix::errno::Errno;
use nix::sched::{CloneFlags, setns};
use nix::sys::signal::kill;
use nix::unistd::Pid;

use crate::{LinkError, kernel};

/// Where `ip` keeps the named namespaces.
const FOLDER: &str = "/run/netns";
const SHARED_MEMORY: &str = "/dev/shm";
/// The network device of the link, in each namespace.
pub const DEVICE: &str = "wifi0";
/// As on Ethernet and Wi-Fi.
const MTU: u32 = 1500;

/// A network namespace that is removed with this value. Programs that still run in it keep a network without the link.
pub struct Namespace {
    pub name: String,
    /// Keeps the way in, also if somebody takes the name away.
    file: Arc<File>,
    /// What programs inside have for `/dev/shm`; `None` where this machine has none.
    shared_memory: Option<PathBuf>,
}

impl Namespace {
    /// Makes one with loopback up.
    pub fn new(name: &str) -> Result<Self, LinkError> {
        // Of a killed process that had our pid.
        remove(name);
        // Where this is refused, there are no namespaces to be had: no privileges, or a container.
        ip(&["netns", "add", name])
            .map_err(|got| LinkError::NotPossible(format!("`ip netns add {name}` failed: {got}")))?;
        let path = Path::new(FOLDER).join(name);
        let opened = File::open(&path).map_err(|error| setup(format!("opening {}", path.display()), &error));
        let file = Arc::new(opened.inspect_err(|_| remove(name))?);
        let namespace = Self { name: name.to_owned(), file, shared_memory: make_shared_memory(name)? };
        namespace.configure("link set lo up\n")?;
        Ok(namespace)
    }

    /// Makes the TUN device, gives it an address with a /24 around it, and sends multicast through it.
    pub fn add_tun(&self, address: Ipv4Addr) -> Result<File, LinkError> {
        let tun = self
            .inside(|| {
                let tun = kernel::open_tun(DEVICE)?;
                // Only so that nothing passes that nobody sent: without an address of its own, IPv6 is silent. Not on old kernels.
                let _ = fs::write(format!("/proc/sys/net/ipv6/conf/{DEVICE}/disable_ipv6"), "1");
                Ok(tun)
            })
            .and_then(|opened: io::Result<File>| opened)
            .map_err(|error| {
                // Missing, forbidden (a container), or a file without the module behind it.
                let is_not_here = [Errno::ENOENT, Errno::EPERM, Errno::EACCES, Errno::ENODEV, Errno::ENXIO]
                    .iter()
                    .any(|errno| error.raw_os_error() == Some(*errno as i32));
                if is_not_here {
                    return LinkError::NotPossible(format!("no device can be made with {}: {error}", kernel::TUN_PATH));
                }
                setup(format!("making a device with {}", kernel::TUN_PATH), &error)
            })?;
        self.configure(&format!(
            "addr add {address}/24 broadcast + dev {DEVICE}\n\
             link set {DEVICE} mtu {MTU} multicast on up\n\
             route add 224.0.0.0/4 dev {DEVICE}\n"
        ))?;
        Ok(tun)
    }

    /// Runs the function in a thread inside; what it opens stays inside.
    pub fn inside<T: Send>(&self, run: impl FnOnce() -> T + Send) -> io::Result<T> {
        thread::scope(|scope| {
            let thread = scope.spawn(|| {
                setns(&*self.file, CloneFlags::CLONE_NEWNET)?;
                Ok(run())
            });
            thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
        })
    }

    /// A command that runs inside.
    pub fn command(&self, program: &std::ffi::OsStr) -> Command {
        let shared_memory = self.shared_memory.as_ref().map(|folder| {
            CString::new(folder.as_os_str().as_encoded_bytes()).expect("the name is made of letters and numbers")
        });
        let mut command = Command::new(program);
        kernel::begin_inside(&mut command, Arc::clone(&self.file), shared_memory);
        command
    }

    fn configure(&self, lines: &str) -> Result<(), LinkError> {
        ip_with_input(&["-n", &self.name, "-batch", "-"], lines).map_err(|got| {
            let step = format!("setting up the network of `{}`", self.name);
            // Root in a container may make a namespace and yet not set it up.
            if got.contains("not permitted") {
                LinkError::NotPossible(format!("{step} failed: {got}"))
            } else {
                LinkError::Setup { step, got }
            }
        })
    }
}

impl Drop for Namespace {
    fn drop(&mut self) {
        remove(&self.name);
    }
}

fn setup(step: String, error: &io::Error) -> LinkError {
    LinkError::Setup { step, got: error.to_string() }
}

fn make_shared_memory(name: &str) -> Result<Option<PathBuf>, LinkError> {
    if !Path::new(SHARED_MEMORY).is_dir() {
        return Ok(None);
    }
    let folder = Path::new(SHARED_MEMORY).join(name);
    // Anybody may write, nobody may remove what is another's: as /dev/shm itself.
    fs::create_dir_all(&folder).and_then(|()| fs::set_permissions(&folder, Permissions::from_mode(0o1777))).map_err(
        |error| {
            remove(name);
            setup(format!("making {}", folder.display()), &error)
        },
    )?;
    Ok(Some(folder))
}

/// Removes a namespace and its shared memory, as far as they are there.
fn remove(name: &str) {
    if Path::new(FOLDER).join(name).exists() {
        // Another process may have been faster with what a third one left. There is nobody to tell of anything else.
        let _ = ip(&["netns", "del", name]);
    }
    let _ = fs::remove_dir_all(Path::new(SHARED_MEMORY).join(name));
}

/// Removes what processes left that were killed.
pub fn remove_leftovers() {
    for folder in [FOLDER, SHARED_MEMORY] {
        let entries = fs::read_dir(folder).into_iter().flatten().flatten();
        for name in entries.filter_map(|entry| entry.file_name().into_string().ok()) {
            if maker(&name).is_some_and(|pid| kill(pid, None) == Err(Errno::ESRCH)) {
                remove(&name);
            }
        }
    }
}

/// The name of the `index`-th link of this process; the first has none in its name.
pub fn name_of(index: u32, host: &str) -> String {
    let pid = std::process::id();
    if index == 0 { format!("carril-{pid}-{host}") } else { format!("carril-{pid}-{host}-{}", index + 1) }
}

/// The process that made a namespace; `None` if it is none of ours.
fn maker(name: &str) -> Option<Pid> {
    let (pid, host) = name.strip_prefix("carril-")?.split_once('-')?;
    let (host, index) = host.split_once('-').unwrap_or((host, "1"));
    let is_ours = ["car", "laptop"].contains(&host) && index.parse::<u32>().is_ok();
    // 0 and negative numbers would mean groups of processes.
    let pid = pid.parse().ok().filter(|pid| *pid > 0)?;
    is_ours.then_some(Pid::from_raw(pid))
}

fn ip(arguments: &[&str]) -> Result<(), String> {
    ip_with_input(arguments, "")
}

/// Runs `ip`; the error is what it says.
fn ip_with_input(arguments: &[&str], input: &str) -> Result<(), String> {
    let not_run = |error: io::Error| format!("cannot run `ip` (package iproute2): {error}");
    let mut child = Command::new("ip")
        .args(arguments)
        .env("LC_ALL", "C")
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        // A Ctrl-C is for us: `ip` is what cleans up after it.
        .process_group(0)
        .spawn()
        .map_err(not_run)?;
    // Where it ends before it has read all, its exit code and message say why.
    let _ = child.stdin.take().expect("it is piped").write_all(input.as_bytes());
    let output = child.wait_with_output().map_err(not_run)?;
    if output.status.success() {
        return Ok(());
    }
    let said = String::from_utf8_lossy(&output.stderr);
    Err(if said.trim().is_empty() { output.status.to_string() } else { said.trim().to_owned() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn knows_its_own_names_and_no_others() {
        let pid = Pid::this();
        for index in [0, 1, 41] {
            for host in ["car", "laptop"] {
                assert_eq!(maker(&name_of(index, host)), Some(pid), "link {index}, {host}");
            }
        }
        for other in [
            "carril-car",
            "carril-12",
            "carril-x-car",
            "carril-12-bus",
            "carril-12-car-x",
            "carril--1-car",
            "carril-0-car",
            "net1",
        ] {
            assert_eq!(maker(other), None, "`{other}` would be removed");
        }
    }
}
