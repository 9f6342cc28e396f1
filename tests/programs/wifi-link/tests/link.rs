//! The link with the kernel's network at both ends. Skipped, with a message, where a namespace cannot be had.
//!
//! Times are only ever bounded from below: a busy machine makes everything late. Waits are bounded so that a defect ends the
//! test instead of hanging it.

use std::collections::BTreeSet;
use std::fs;
use std::io::{self, Read, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::process::Command;
use std::thread;
use std::time::{Duration, Instant};

use wifi_link::Direction::{CarToLaptop, LaptopToCar};
use wifi_link::{Conditions, Counters, Direction, Host, LinkError, Queue, WifiLink};

/// After this, something is broken.
const HANG: Duration = Duration::from_secs(60);
/// Of IPv4 and UDP, without options.
const HEADER_BYTES: u64 = 20 + 8;

/// A link, or `None` with a message where it is not possible.
fn link(conditions: Conditions) -> Option<WifiLink> {
    match WifiLink::new(conditions) {
        Ok(link) => Some(link),
        Err(LinkError::NotPossible(reason)) => {
            eprintln!("skipped: {reason}");
            None
        }
        Err(error) => panic!("{error}"),
    }
}

fn udp(host: &Host) -> UdpSocket {
    let address = host.address();
    let socket =
        host.inside(|| UdpSocket::bind((address, 0))).expect("the namespace is there").expect("a port is free");
    socket.set_read_timeout(Some(HANG)).expect("it is not zero");
    socket
}

/// A socket at each end, connected to each other: the car's and the laptop's.
fn pair(link: &WifiLink) -> (UdpSocket, UdpSocket) {
    let (car, laptop) = (udp(link.car()), udp(link.laptop()));
    car.connect(laptop.local_addr().expect("it is bound")).expect("there is a route");
    laptop.connect(car.local_addr().expect("it is bound")).expect("there is a route");
    (car, laptop)
}

/// The next packet, and who sent it.
fn receive(socket: &UdpSocket, bytes: &mut [u8]) -> (usize, SocketAddr) {
    loop {
        match socket.recv_from(bytes) {
            // With a time limit the kernel does not resume the call by itself, and a child of another test that ends is enough.
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            received => return received.expect("it arrives"),
        }
    }
}

/// Waits until nothing is under way, and every packet sent has come to the link.
fn settle(link: &WifiLink, direction: Direction, sent: u64) -> Counters {
    let begin = Instant::now();
    loop {
        let counters = link.counters(direction);
        if counters.sent_packets >= sent && counters.under_way_packets == 0 {
            return counters;
        }
        assert!(begin.elapsed() < HANG, "waited in vain for {sent} packets: {counters:?}");
        thread::sleep(Duration::from_micros(200));
    }
}

/// The numbers that have arrived.
fn drain(socket: &UdpSocket) -> Vec<u32> {
    socket.set_nonblocking(true).expect("a socket can");
    let mut numbers = Vec::new();
    let mut bytes = [0; 4];
    loop {
        match socket.recv(&mut bytes) {
            Ok(4) => numbers.push(u32::from_be_bytes(bytes)),
            Ok(len) => panic!("got {len} bytes, sent were 4"),
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
            Err(error) => panic!("{error}"),
        }
    }
    socket.set_nonblocking(false).expect("a socket can");
    numbers
}

fn namespaces() -> String {
    let output = Command::new("ip").args(["netns", "list"]).output().expect("a link was made with it");
    String::from_utf8(output.stdout).expect("names are text")
}

#[test]
fn packets_pass_both_ways_with_the_addresses_of_the_hosts() {
    let Some(link) = link(Conditions::perfect()) else { return };
    assert_ne!(link.car().address(), link.laptop().address(), "two hosts");
    let (car, laptop) = (udp(link.car()), udp(link.laptop()));
    car.send_to(b"ping", laptop.local_addr().expect("it is bound")).expect("there is a route");
    let mut bytes = [0; 16];
    let (len, from) = receive(&laptop, &mut bytes);
    assert_eq!((&bytes[..len], from), (&b"ping"[..], car.local_addr().expect("it is bound")), "what the car sent");
    laptop.send_to(b"echo", from).expect("there is a route");
    let (len, from) = receive(&car, &mut bytes);
    assert_eq!(
        (&bytes[..len], from),
        (&b"echo"[..], laptop.local_addr().expect("it is bound")),
        "what the laptop sent"
    );
    for direction in Direction::BOTH {
        let counters = settle(&link, direction, 1);
        assert_eq!((counters.delivered_packets, counters.delivered_bytes), (1, HEADER_BYTES + 4), "{direction:?}");
    }
}

#[test]
fn a_stream_arrives_whole_over_a_bad_link() {
    let Some(link) = link(Conditions::good()) else { return };
    let sent: Vec<u8> = (0..300_000_u32).flat_map(u32::to_be_bytes).take(300_000).collect();
    let address = link.laptop().address();
    let listener = link.laptop().inside(|| TcpListener::bind((address, 0))).unwrap().unwrap();
    let port = listener.local_addr().unwrap().port();
    let mut stream = link.car().inside(|| TcpStream::connect((address, port))).unwrap().expect("it connects");
    let (mut accepted, from) = listener.accept().unwrap();
    assert_eq!(from.ip(), link.car().address(), "the car's address");
    let received = thread::scope(|scope| {
        scope.spawn(|| {
            stream.write_all(&sent).unwrap();
            stream.shutdown(std::net::Shutdown::Write).unwrap();
        });
        let mut received = Vec::new();
        accepted.read_to_end(&mut received).unwrap();
        received
    });
    assert!(received == sent, "{} of {} bytes arrived, or others", received.len(), sent.len());
    assert!(link.counters(LaptopToCar).delivered_packets > 0, "no acknowledgement passed");
}

/// Sends `count` numbered packets, few at a time so that no buffer of the kernel overflows; those that arrived.
fn survivors(conditions: Conditions, count: u32) -> Option<(Vec<u32>, Counters)> {
    let link = link(conditions)?;
    let (car, laptop) = pair(&link);
    let mut arrived = Vec::new();
    for number in 0..count {
        car.send(&number.to_be_bytes()).expect("there is a route");
        if number % 50 == 49 {
            settle(&link, CarToLaptop, u64::from(number) + 1);
            arrived.extend(drain(&laptop));
        }
    }
    Some((arrived, link.counters(CarToLaptop)))
}

#[test]
fn loses_its_share_keeps_the_order_and_repeats_itself() {
    const COUNT: u32 = 4_000;
    let conditions = Conditions {
        delay: Duration::from_millis(2),
        jitter: Duration::from_millis(2),
        loss: 0.1,
        queue: Queue::Bytes(u64::MAX),
        ..Conditions::good()
    };
    let Some((arrived, counters)) = survivors(conditions.clone(), COUNT) else { return };
    assert!(arrived.is_sorted(), "the order is not kept");
    let lost = counters.lost_packets;
    let (expected, sigma) = (0.1 * f64::from(COUNT), (f64::from(COUNT) * 0.1 * 0.9).sqrt());
    assert!((lost as f64 - expected).abs() < 6.0 * sigma, "lost {lost}, expected {expected} ± {}", 6.0 * sigma);
    assert_eq!(arrived.len() as u64 + lost, u64::from(COUNT), "what is not lost arrives once: {counters:?}");
    let (again, _) = survivors(conditions.clone(), COUNT).expect("it was possible before");
    assert_eq!(arrived, again, "the same seed loses the same packets");
    let (other, _) = survivors(Conditions { seed: 2, ..conditions }, COUNT).expect("it was possible before");
    assert_ne!(arrived, other, "another seed loses others");
}

#[test]
fn no_packet_takes_less_than_the_least_delay() {
    let conditions = Conditions { loss: 0.0, ..Conditions::good() };
    let Some(link) = link(conditions.clone()) else { return };
    let least = conditions.delay.checked_sub(conditions.jitter).expect("conditions are checked");
    let (car, laptop) = pair(&link);
    let mut bytes = [0; 4];
    for number in 0..200_u32 {
        let begin = Instant::now();
        car.send(&number.to_be_bytes()).expect("there is a route");
        receive(&laptop, &mut bytes);
        let took = begin.elapsed();
        assert!(took >= least, "packet {number} took {took:?}, less than {least:?}");
    }
}

#[test]
fn no_more_passes_than_the_rate_also_after_it_changed() {
    let Some(link) = link(Conditions::perfect()) else { return };
    let (car, laptop) = pair(&link);
    for rate in [2_000_000, 4_000_000] {
        let queue = Queue::Bytes(u64::MAX);
        link.set(Conditions { rate_bit_s: Some(rate), queue, ..Conditions::perfect() }).expect("it is possible");
        let mut bytes = [0; 1400];
        let begin = Instant::now();
        for _ in 0..40 {
            car.send(&bytes).expect("there is a route");
        }
        for count in 1..=40 {
            receive(&laptop, &mut bytes);
            let (took, bits) = (begin.elapsed(), count * 8 * (bytes.len() as u64 + HEADER_BYTES));
            let least = Duration::from_secs_f64(bits as f64 / rate as f64);
            assert!(took >= least, "{bits} bits in {took:?}: at {rate} bit/s they take {least:?}");
        }
    }
}

#[test]
fn a_full_queue_delays_and_then_drops() {
    // 20 packets of 1 KB at 80 kbit/s: 0.1 s each.
    let conditions =
        Conditions { rate_bit_s: Some(80_000), queue: Queue::Time(Duration::from_secs(1)), ..Conditions::perfect() };
    let Some(link) = link(conditions) else { return };
    let (car, _laptop) = pair(&link);
    let begin = Instant::now();
    for _ in 0..20 {
        car.send(&[0; 1000 - HEADER_BYTES as usize]).expect("there is a route");
    }
    let mut counters = link.counters(CarToLaptop);
    while counters.sent_packets < 20 {
        assert!(begin.elapsed() < HANG, "the packets do not come: {counters:?}");
        counters = link.counters(CarToLaptop);
    }
    // On a machine that is busy enough, it has drained before this looked; what it has sent by now is known, though.
    let drained = begin.elapsed().as_secs_f64() * 10.0;
    let (drops, least) = (counters.queue_drops as f64, 20.0 - 11.0 - drained);
    assert!(drops >= least.floor(), "{drops} drops, at least {least} expected: {counters:?}");
    assert!(counters.queue_delay <= Duration::from_millis(1100), "more waits than may: {counters:?}");
}

#[test]
fn an_outage_passes_nothing_and_afterwards_it_passes_again() {
    let Some(link) = link(Conditions { loss: 0.0, ..Conditions::good() }) else { return };
    let (car, laptop) = pair(&link);
    let send = |numbers: std::ops::Range<u32>| {
        for number in numbers {
            car.send(&number.to_be_bytes()).expect("there is a route");
        }
    };
    send(0..10);
    settle(&link, CarToLaptop, 10);
    assert_eq!(drain(&laptop), (0..10).collect::<Vec<_>>(), "before");

    link.cut();
    send(10..30);
    let counters = settle(&link, CarToLaptop, 30);
    assert_eq!((drain(&laptop), counters.outage_drops, link.is_cut()), (vec![], 20, true), "in the outage");

    link.restore();
    send(30..40);
    settle(&link, CarToLaptop, 40);
    assert_eq!(drain(&laptop), (30..40).collect::<Vec<_>>(), "afterwards");

    link.plan_outage(Duration::ZERO, Duration::from_secs(3600));
    send(40..50);
    settle(&link, CarToLaptop, 50);
    assert_eq!((drain(&laptop), link.is_cut()), (vec![], true), "in a planned outage");

    link.restore();
    send(50..60);
    settle(&link, CarToLaptop, 60);
    assert_eq!((drain(&laptop), link.is_cut()), ((50..60).collect(), false), "after it");
}

#[test]
fn multicast_arrives_at_the_other_end() {
    // The group and port of Zenoh's scouting.
    const GROUP: Ipv4Addr = Ipv4Addr::new(224, 0, 0, 224);
    let Some(link) = link(Conditions::perfect()) else { return };
    let to = SocketAddr::from((GROUP, 7446));
    for (from, into) in [(link.car(), link.laptop()), (link.laptop(), link.car())] {
        let address = into.address();
        let listener = into
            .inside(|| {
                let socket = UdpSocket::bind(to)?;
                socket.join_multicast_v4(&GROUP, &address)?;
                socket.set_read_timeout(Some(HANG))?;
                Ok::<_, io::Error>(socket)
            })
            .expect("the namespace is there")
            .expect("the device takes groups");
        // Bound to no address: the route decides, as for a program that knows nothing of the device.
        let sender =
            from.inside(|| UdpSocket::bind("0.0.0.0:0")).expect("the namespace is there").expect("a port is free");
        sender.send_to(b"scout", to).expect("there is a route for multicast");
        let mut bytes = [0; 16];
        let (len, source) = receive(&listener, &mut bytes);
        assert_eq!((&bytes[..len], source.ip()), (&b"scout"[..], from.address().into()), "what was sent");
    }
}

#[test]
fn a_command_runs_on_its_host_with_shared_memory_of_its_own() {
    let Some(link) = link(Conditions::perfect()) else { return };
    let run = |host: &Host, script: &str| {
        let output = host.command("sh").args(["-c", script]).output().expect("there is a shell");
        assert!(output.status.success(), "`{script}`: {}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).expect("it is text")
    };
    let devices = run(link.car(), "ip -4 -brief address show wifi0");
    assert!(devices.contains(&format!("{}/24", link.car().address())), "the car has {devices}");
    let name = format!("wifi-link-{}", std::process::id());
    run(link.car(), &format!("echo here > /dev/shm/{name}"));
    assert_eq!(run(link.car(), &format!("cat /dev/shm/{name}")), "here\n", "the car's commands share it");
    assert_eq!(run(link.laptop(), "ls -A /dev/shm"), "", "the laptop sees nothing of it");
    assert!(!fs::exists(format!("/dev/shm/{name}")).unwrap(), "nor does this machine");
    let error = link.car().command("/no/such/program").spawn().expect_err("there is none");
    assert_eq!(error.kind(), io::ErrorKind::NotFound, "as of any other command");
}

#[test]
fn dropping_it_leaves_nothing_also_in_a_panic() {
    let Some(link) = link(Conditions::perfect()) else { return };
    let names = [link.car().namespace().to_owned(), link.laptop().namespace().to_owned()];
    let is_there = |name: &str| {
        namespaces().split_whitespace().any(|word| word == name) || fs::exists(format!("/dev/shm/{name}")).unwrap()
    };
    assert!(names.iter().all(|name| is_there(name)), "{names:?} are to be in {}", namespaces());
    let panic = catch_unwind(AssertUnwindSafe(move || {
        let _link = link;
        std::panic::resume_unwind(Box::new("on purpose"));
    }));
    assert!(panic.is_err(), "it panicked");
    assert!(!names.iter().any(|name| is_there(name)), "{names:?} are still in {}", namespaces());
}

#[test]
fn removes_what_a_dead_process_left_and_nothing_of_a_living_one() {
    let Some(first) = link(Conditions::perfect()) else { return };
    let mut child = Command::new("true").spawn().expect("it is everywhere");
    let dead = child.id();
    child.wait().expect("it ends");
    let leftover = format!("carril-{dead}-laptop-2");
    assert!(Command::new("ip").args(["netns", "add", &leftover]).status().unwrap().success(), "it can be made");
    fs::create_dir_all(format!("/dev/shm/{leftover}")).unwrap();
    let _second = link(Conditions::perfect()).expect("it was possible before");
    let there = namespaces();
    let there: BTreeSet<&str> = there.split_whitespace().collect();
    assert!(!there.contains(leftover.as_str()), "`{leftover}` is still there");
    assert!(!fs::exists(format!("/dev/shm/{leftover}")).unwrap(), "its shared memory is still there");
    assert!(there.contains(first.car().namespace()), "`{}` was taken from a living process", first.car().namespace());
}

#[test]
fn refuses_impossible_conditions_and_keeps_the_old_ones() {
    let bad = Conditions { loss: 2.0, ..Conditions::good() };
    // Also where a link is not possible: what is wrong with the test is said first.
    assert!(matches!(WifiLink::new(bad.clone()), Err(LinkError::BadConditions(_))), "a loss of 200 %");
    let Some(link) = link(Conditions::slow()) else { return };
    assert!(matches!(link.set(bad), Err(LinkError::BadConditions(_))), "a loss of 200 %");
    assert_eq!(link.conditions(), Conditions::slow(), "as before");
}
