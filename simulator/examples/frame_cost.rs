//! Prints what a frame, a scan and a step cost: `cargo run --release -p carril-simulator --example frame_cost [TRACK] [OUT.png]`.

use std::time::{Duration, Instant};

use carril_messages::Stamp;
use carril_runtime::{Context, HeapPool, Operator, Setup, Trigger};
use carril_simulator::camera::light::Lighting;
use carril_simulator::{SimWorld, SimWorldConfig, WorldInputs, WorldOutputs};

/// Time per step in µs, over some seconds of simulated time.
fn cost(config: &SimWorldConfig, camera: bool, lane: bool, file: Option<&str>) -> f64 {
    let mut world = SimWorld::new(config.clone(), &Setup::for_tests("world")).expect("a good configuration");
    let (mut inputs, mut outputs) = (WorldInputs::default(), WorldOutputs::default());
    outputs.camera.set_wanted(camera);
    outputs.lane.set_wanted(lane);
    let (steps, mut now, mut last) = (2000, Stamp::ZERO, None);
    let started = Instant::now();
    for _ in 0..steps {
        world.step(&mut inputs, &mut outputs, &Context::new(now, Trigger::Period, &HeapPool)).expect("a step");
        last = outputs.camera.sent().pop().or(last);
        let _unread = (
            outputs.scan.sent(),
            outputs.sensors.sent(),
            outputs.vehicle.sent(),
            outputs.progress.sent(),
            outputs.lane.sent(),
        );
        now = now + Duration::from_millis(5);
    }
    let took = started.elapsed();
    if let (Some(file), Some(image)) = (file, last) {
        let rgb = image.pixels().chunks_exact(3).flat_map(|bgr| [bgr[2], bgr[1], bgr[0]]).collect();
        let picture = image::RgbImage::from_raw(image.width(), image.height(), rgb).expect("the size fits");
        picture.save(file).expect("the file can be written");
    }
    took.as_secs_f64() * 1e6 / f64::from(steps)
}

fn main() {
    let track = std::env::args().nth(1).unwrap_or_else(|| "oval".into());
    let file = std::env::args().nth(2);
    let mut config = SimWorldConfig { track, ..SimWorldConfig::default() };
    let bare = cost(&config, false, false, None);
    println!("step without camera   {bare:9.1} µs   ({:.0} x real time)", 5000.0 / bare);
    println!("step with ideal lane  {:9.1} µs", cost(&config, false, true, None));
    for lighting in [Lighting::DimGradient, Lighting::Even] {
        config.camera.lighting = lighting;
        let frame = (cost(&config, true, false, file.as_deref()) - bare) * 2000.0 / 301.0;
        println!("frame, {lighting:?}: {frame:9.1} µs");
    }
}
