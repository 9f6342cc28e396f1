//! scratch
mod support;
use support::{measure, plain};
use std::process::*; use std::io::*; use std::time::Duration;
fn main() {
    let a: Vec<String> = std::env::args().collect();
    match a.get(1).map(String::as_str) {
        Some("src") => plain::source(&a[2], a[3].parse().unwrap(), a[4].parse().unwrap(), Duration::from_millis(5)),
        Some("sink") => { let s = plain::sink(&a[2], a[3].parse().unwrap()); println!("p50 {:.1} p99 {:.1} cpu {:.0}", s.quantile_us(0.5), s.quantile_us(0.99), measure::cpu_us()); }
        _ => for size in ["16","1024","65536","921600"] { for _ in 0..2 {
            let ep = format!("unixsock-stream//tmp/zb{}.sock", std::process::id());
            let me = std::env::current_exe().unwrap();
            let mut sink = Command::new(&me).args(["sink",&ep,"400"]).stdout(Stdio::piped()).spawn().unwrap();
            let mut out = BufReader::new(sink.stdout.take().unwrap()); let mut l = String::new(); out.read_line(&mut l).unwrap();
            let mut src = Command::new(&me).args(["src",&ep,size,"400"]).spawn().unwrap();
            l.clear(); out.read_line(&mut l).unwrap(); print!("{size}: {l}"); sink.wait().unwrap(); src.wait().unwrap();
        }}
    }
}
