//! What the kernel knows of a TCP connection. No crate that is here already asks it for that.

use std::os::fd::{AsRawFd, BorrowedFd};
use std::time::Duration;

/// The smoothed round trip. `None`: this is no TCP connection, or nothing was measured yet.
pub fn round_trip(socket: BorrowedFd<'_>) -> Option<Duration> {
    let mut info = std::mem::MaybeUninit::<libc::tcp_info>::zeroed();
    let mut length = size_of::<libc::tcp_info>() as libc::socklen_t;
    #[allow(unsafe_code, reason = "getsockopt(2) writes into a struct of the kernel's")]
    let info = unsafe {
        // SAFETY: the socket is open while it is borrowed, and the kernel writes at most `length` bytes. All of them zero is a value, too.
        let into = info.as_mut_ptr().cast();
        if libc::getsockopt(socket.as_raw_fd(), libc::IPPROTO_TCP, libc::TCP_INFO, into, &raw mut length) != 0 {
            return None;
        }
        info.assume_init()
    };
    (info.tcpi_rtt > 0).then(|| Duration::from_micros(info.tcpi_rtt.into()))
}

#[cfg(test)]
mod tests {
    use std::os::fd::AsFd;

    use super::*;

    #[test]
    fn a_connection_has_a_round_trip_and_a_file_has_none() {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port");
        let near = std::net::TcpStream::connect(listener.local_addr().expect("it listens")).expect("it connects");
        let _far = listener.accept().expect("it is accepted");
        assert!(round_trip(near.as_fd()).is_some(), "the handshake was one");
        let file = std::fs::File::open("/dev/null").expect("Linux");
        assert_eq!(round_trip(file.as_fd()), None, "no connection");
    }
}
