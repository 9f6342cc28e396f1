//! The camera as a whole: files of every kind, good and damaged, and a device that comes and goes.

use std::fs;
use std::path::Path;
use std::sync::mpsc;
use std::sync::{Arc, Mutex};

use carril_messages::Encoding;
use carril_runtime::clock::VirtualClock;
use carril_runtime::{AnyOutput, Provenance, Waker};
use opencv::core::{Mat, Scalar, Size, Vector};
use opencv::prelude::*;
use opencv::videoio::VideoWriter;
use opencv::{core, imgcodecs};
use serde_json::{Value, json};

use super::device::{Grabber, Opener};
use super::pixels::Lend;
use super::*;
use crate::testing::{at_ms, context};

fn solid(width: i32, height: i32, grey: u8) -> Mat {
    Mat::new_rows_cols_with_default(height, width, core::CV_8UC3, Scalar::all(f64::from(grey))).expect("a valid size")
}

fn save(folder: &Path, name: &str, image: &Mat) {
    let path = folder.join(name);
    assert!(imgcodecs::imwrite(&path, image, &Vector::new()).expect("a known suffix"), "{name} is written");
}

/// A video whose frames get brighter: frame `i` is grey `20 * i`.
fn save_video(folder: &Path, name: &str, frames: u8) {
    let fourcc = VideoWriter::fourcc('M', 'J', 'P', 'G').expect("four letters");
    let size = Size::new(64, 48);
    let mut writer = VideoWriter::new(folder.join(name), fourcc, 25.0, size, true).expect("a writer");
    assert!(writer.is_opened().expect("a state"), "OpenCV can write motion JPEG");
    for frame in 0..frames {
        writer.write(&solid(64, 48, 20 * frame)).expect("a frame");
    }
    writer.release().expect("the end");
}

struct Bench {
    camera: Camera,
    outputs: CameraOutputs,
    now_ms: i64,
}

impl Bench {
    fn open(folder: &Path, config: Value) -> Result<Self, String> {
        let setup = Setup { base_dir: folder.to_owned(), ..Setup::for_tests("camera") };
        let config = serde_json::from_value(config).expect("a valid configuration");
        let camera = Camera::new(config, &setup).map_err(|error| error.to_string())?;
        Ok(Self { camera, outputs: CameraOutputs::default(), now_ms: 0 })
    }

    fn step(&mut self, trigger: Trigger) -> Result<Option<Arc<Image>>, String> {
        self.now_ms += 40;
        let result = self.camera.step(&mut NoInputs, &mut self.outputs, &context(at_ms(self.now_ms), trigger));
        let mut sent = self.outputs.image.sent();
        assert!(sent.len() <= 1, "at most one frame per step");
        result.map(|()| sent.pop()).map_err(|error| error.to_string())
    }

    /// The brightness of the next frame.
    fn next(&mut self) -> Result<Option<u8>, String> {
        Ok(self.step(Trigger::Period)?.map(|image| image.row(image.height() / 2)[3]))
    }
}

#[test]
fn plays_a_folder_in_order_and_falls_silent_once() {
    let folder = tempfile::tempdir().expect("a folder");
    for (name, grey) in [("b.png", 20), ("a.png", 10), ("c.png", 30)] {
        save(folder.path(), name, &solid(32, 16, grey));
    }
    let mut bench = Bench::open(folder.path(), json!({"source": "."})).expect("three images");
    let frames: Vec<_> = (0..3).map(|_| bench.next()).collect();
    assert_eq!(frames, [Ok(Some(10)), Ok(Some(20)), Ok(Some(30))], "by name");
    let end = bench.next().expect_err("the end is said");
    assert!(end.contains("ended after 3 frames") && end.contains("`loop: true`"), "{end}");
    assert_eq!((bench.next(), bench.next()), (Ok(None), Ok(None)), "once");
}

#[test]
fn loops_and_steps_only_at_its_period() {
    let folder = tempfile::tempdir().expect("a folder");
    save(folder.path(), "a.png", &solid(32, 16, 10));
    save(folder.path(), "b.png", &solid(32, 16, 20));
    let mut bench = Bench::open(folder.path(), json!({"source": ".", "loop": true})).expect("two images");
    assert_eq!(bench.step(Trigger::Control), Ok(None), "a word from a person makes no frame");
    let frames: Vec<_> = (0..5).map(|_| bench.next()).collect();
    assert_eq!(frames, [10, 20, 10, 20, 10].map(|grey| Ok(Some(grey))), "again and again");
}

#[test]
fn each_frame_carries_its_own_size_unless_one_is_asked_for() {
    let folder = tempfile::tempdir().expect("a folder");
    save(folder.path(), "a.png", &solid(32, 16, 10));
    save(folder.path(), "b.png", &solid(48, 40, 20));
    let sizes = |config: Value| {
        let mut bench = Bench::open(folder.path(), config).expect("two images");
        [0, 1].map(|_| {
            let image = bench.step(Trigger::Period).expect("a step").expect("a frame");
            (image.width(), image.height(), image.encoding())
        })
    };
    let own = sizes(json!({"source": "."}));
    assert_eq!(own, [(32, 16, Encoding::Bgr8), (48, 40, Encoding::Bgr8)], "as in the files");
    let asked = sizes(json!({"source": ".", "width": 20, "height": 24, "encoding": "mono8"}));
    assert_eq!(asked, [(20, 24, Encoding::Mono8); 2], "scaled");
}

#[test]
fn stamps_frames_of_files_with_the_time_of_the_step() {
    let folder = tempfile::tempdir().expect("a folder");
    save(folder.path(), "a.png", &solid(32, 16, 10));
    let mut bench = Bench::open(folder.path(), json!({"source": "a.png"})).expect("an image");
    bench.camera.step(&mut NoInputs, &mut bench.outputs, &context(at_ms(123), Trigger::Period)).expect("a frame");
    let mut stamps = Vec::new();
    bench.outputs.image.drain(&mut |outgoing| stamps.push(outgoing.provenance));
    assert_eq!(stamps, [Provenance::Captured(at_ms(123))], "the chain of ages begins here");
}

#[test]
fn plays_a_video_and_goes_on_where_a_predecessor_stopped() {
    let folder = tempfile::tempdir().expect("a folder");
    save_video(folder.path(), "drive.avi", 6);
    let near = |got: Result<Option<u8>, String>, expected: u8| {
        let grey = got.expect("a step").expect("a frame");
        assert!(grey.abs_diff(expected) <= 3, "got {grey}, expected {expected}");
    };
    let mut first = Bench::open(folder.path(), json!({"source": "drive.avi"})).expect("a video");
    for frame in 0..4 {
        near(first.next(), 20 * frame);
    }
    let mut second = Bench::open(folder.path(), json!({"source": "drive.avi"})).expect("a video");
    second.camera.restore(first.camera.snapshot()).expect("a valid state");
    near(second.next(), 80);
    near(second.next(), 100);
    let end = second.next().expect_err("the end is said");
    assert!(end.contains("ended after 6 frames"), "{end}");
    let mut looped = Bench::open(folder.path(), json!({"source": "drive.avi", "loop": true})).expect("a video");
    for frame in (0..6).chain(0..2) {
        near(looped.next(), 20 * frame);
    }
}

#[test]
fn a_damaged_image_is_named_and_passed_over() {
    let folder = tempfile::tempdir().expect("a folder");
    save(folder.path(), "a.png", &solid(32, 16, 10));
    fs::write(folder.path().join("b.png"), b"no image at all").expect("a file");
    save(folder.path(), "c.png", &solid(32, 16, 30));
    let mut bench = Bench::open(folder.path(), json!({"source": "."})).expect("three files");
    assert_eq!(bench.next(), Ok(Some(10)), "the first is good");
    let damage = bench.next().expect_err("the second is not");
    assert!(damage.contains("frame 2") && damage.contains("b.png` cannot be read as an image"), "{damage}");
    assert_eq!(bench.next(), Ok(Some(30)), "the third is");
}

#[test]
fn images_that_are_all_damaged_do_not_loop_for_ever() {
    let folder = tempfile::tempdir().expect("a folder");
    fs::write(folder.path().join("a.png"), b"no image at all").expect("a file");
    let mut bench = Bench::open(folder.path(), json!({"source": ".", "loop": true})).expect("one file");
    assert!(bench.next().is_err(), "damaged");
    let end = bench.next().expect_err("no second pass");
    assert!(end.contains("gave no frame that can be decoded"), "{end}");
    assert_eq!(bench.next(), Ok(None), "silent");
}

#[test]
fn refuses_a_file_that_is_no_video() {
    let folder = tempfile::tempdir().expect("a folder");
    fs::write(folder.path().join("drive.mp4"), vec![7; 5000]).expect("a file");
    let error = Bench::open(folder.path(), json!({"source": "drive.mp4"})).err().expect("it cannot be opened");
    assert!(error.contains("drive.mp4` cannot be read as a video"), "{error}");
}

#[test]
fn a_video_that_is_cut_off_gives_what_is_there() {
    let folder = tempfile::tempdir().expect("a folder");
    save_video(folder.path(), "whole.avi", 10);
    let whole = fs::read(folder.path().join("whole.avi")).expect("the video");
    for share in [0.0, 0.02, 0.3, 0.6, 0.95] {
        fs::write(folder.path().join("cut.avi"), &whole[..(whole.len() as f64 * share) as usize]).expect("a file");
        let Ok(mut bench) = Bench::open(folder.path(), json!({"source": "cut.avi"})) else { continue };
        let frames = (0..20).filter(|_| matches!(bench.next(), Ok(Some(_)))).count();
        assert!(frames < 10, "{share} of the file cannot hold all frames, got {frames}");
        assert_eq!(bench.next(), Ok(None), "and then it is silent");
    }
}

#[test]
fn a_device_cannot_run_in_lockstep() {
    let error = Bench::open(Path::new("."), json!({"source": "/dev/video0"})).err().expect("refused");
    assert!(error.contains("cannot run in lockstep") && error.contains("`sim-world`"), "{error}");
}

#[test]
fn missing_files_are_named() {
    let error = Bench::open(Path::new("."), json!({"source": "none.mp4"})).err().expect("refused");
    assert!(error.contains("none.mp4` does not exist"), "{error}");
}

fn device_config() -> CameraConfig {
    serde_json::from_value(json!({"source": "/dev/fake"})).expect("valid")
}

/// A camera for tests: gives the frames of its script and is then gone.
struct Fake(std::vec::IntoIter<(u32, u8)>);

impl Grabber for Fake {
    fn grab(&mut self) -> bool {
        !self.0.as_slice().is_empty()
    }

    fn configure(&mut self, _config: &CameraConfig) {}

    fn retrieve(&mut self, lend: Lend<'_>) -> Result<Image, String> {
        let (width, grey) = self.0.next().ok_or("no frame was grabbed")?;
        let mut buffer = lend(width as usize);
        buffer.fill(grey);
        Image::packed(width, 1, Encoding::Mono8, buffer.freeze()).map_err(|error| error.to_string())
    }
}

/// A live setup whose wakes can be waited for.
fn live() -> (Setup, mpsc::Receiver<()>) {
    let (wake, woken) = mpsc::channel();
    let wake = Mutex::new(wake);
    let waker = Waker::new(move || {
        // The test may have ended.
        let _ = wake.lock().expect("nothing panics in here").send(());
    });
    let clock = Arc::new(VirtualClock::default());
    clock.advance_to(at_ms(77));
    (Setup { waker, clock, memory_lines: None, ..Setup::for_tests("camera") }, woken)
}

#[test]
fn a_device_that_goes_away_comes_back() {
    // Each opening: a script of frames, or a refusal.
    let mut script = vec![
        Err("cannot be opened"),
        Err("cannot be opened"),
        Ok(vec![(4, 10), (4, 11)]),
        Err("cannot be opened"),
        Ok(vec![(6, 20)]),
        Err("cannot be opened"),
    ]
    .into_iter();
    let (next, wait) = mpsc::sync_channel::<()>(0);
    let open: Opener = Box::new(move |_| {
        // One opening at a time, so that the test sees each of them.
        if wait.recv().is_err() {
            return Err("the test has ended".into());
        }
        match script.next() {
            Some(Ok(frames)) => Ok(Box::new(Fake(frames.into_iter()))),
            _ => Err("cannot be opened".into()),
        }
    });
    let (setup, woken) = live();
    let device = DeviceThread::start("fake".into(), device_config(), open, &setup).expect("a thread");
    let mut seen = Vec::new();
    let mut troubles = Vec::new();
    for _ in 0..6 {
        next.send(()).expect("the thread is there");
    }
    // The sixth opening was asked for after the fifth device was gone, so everything has been handed over by now.
    while woken.try_recv().is_ok() {}
    let handover = device.take();
    seen.extend(handover.frame.map(|(image, captured)| (image.width(), image.pixels()[0], captured)));
    troubles.extend(handover.trouble);
    assert_eq!(seen, [(6, 20, at_ms(77))], "the newest frame, with its own size and the time of its grab");
    assert_eq!(handover.reconnects, 1, "it came back once");
    assert_eq!(troubles.len(), 1, "told: {troubles:?}");
    assert!(troubles[0].contains("camera `fake`: stopped delivering frames; tries again"), "{troubles:?}");
    drop(next);
    drop(device);
}

#[test]
fn trouble_is_told_once_per_outage() {
    let (asked, asks) = mpsc::channel();
    let open: Opener = Box::new(move |_| {
        // The test may have seen enough.
        let _ = asked.send(());
        Err("cannot be opened".into())
    });
    let (setup, woken) = live();
    let device = DeviceThread::start("fake".into(), device_config(), open, &setup).expect("a thread");
    for _ in 0..3 {
        asks.recv().expect("it tries again and again");
    }
    assert!(device.take().trouble.is_some_and(|trouble| trouble.contains("cannot be opened")), "told");
    assert_eq!(woken.try_iter().count(), 1, "once");
    asks.recv().expect("and tries on");
    assert!(device.take().trouble.is_none(), "in silence");
}

#[test]
fn a_missing_device_is_no_reason_to_die() {
    let (setup, woken) = live();
    let config: CameraConfig = serde_json::from_value(json!({"source": "/dev/no-such-camera"})).expect("valid");
    assert_eq!(Camera::period(&config), None, "a device sets its own pace");
    let mut camera = Camera::new(config, &setup).expect("it may come later");
    woken.recv().expect("the thread tells");
    let mut outputs = CameraOutputs::default();
    let step = camera.step(&mut NoInputs, &mut outputs, &context(at_ms(1), Trigger::Wake));
    let trouble = step.expect_err("it is told").to_string();
    assert!(trouble.contains("`/dev/no-such-camera`: cannot be opened"), "{trouble}");
    assert!(outputs.image.sent().is_empty(), "no frame");
}

#[test]
fn the_newest_frame_wins() {
    let frames: Vec<_> = (0..50).map(|grey| (4, grey)).collect();
    let mut script = Some(frames);
    let (gone, is_gone) = mpsc::channel();
    let open: Opener = Box::new(move |_| {
        if let Some(frames) = script.take() {
            return Ok(Box::new(Fake(frames.into_iter())));
        }
        // The test may have seen enough.
        let _ = gone.send(());
        Err("gone".into())
    });
    let (setup, _woken) = live();
    let device = DeviceThread::start("fake".into(), device_config(), open, &setup).expect("a thread");
    is_gone.recv().expect("all frames were grabbed");
    let frame = device.take().frame.map(|(image, _)| image.pixels()[0]);
    assert_eq!(frame, Some(49), "the last of fifty");
    assert!(device.take().frame.is_none(), "given once");
}

/// A camera that never ends, and delivers the width that it was last asked for.
struct Endless(u32);

impl Grabber for Endless {
    fn grab(&mut self) -> bool {
        std::thread::sleep(Duration::from_millis(1));
        true
    }

    fn configure(&mut self, config: &CameraConfig) {
        self.0 = config.width.unwrap_or(self.0);
    }

    fn retrieve(&mut self, lend: Lend<'_>) -> Result<Image, String> {
        let buffer = lend(self.0 as usize);
        Image::packed(self.0, 1, Encoding::Mono8, buffer.freeze()).map_err(|error| error.to_string())
    }
}

#[test]
fn a_device_takes_another_size_without_being_opened_again() {
    let (opened, openings) = mpsc::channel();
    let open: Opener = Box::new(move |config| {
        // The test may have seen enough.
        let _ = opened.send(());
        Ok(Box::new(Endless(config.width.unwrap_or(4))))
    });
    let (setup, woken) = live();
    let device = DeviceThread::start("fake".into(), device_config(), open, &setup).expect("a thread");
    let until_width = |width: u32| {
        while device.take().frame.is_none_or(|(image, _)| image.width() != width) {
            woken.recv().expect("frames come");
        }
    };
    until_width(4);
    device.configure(&CameraConfig { width: Some(32), height: Some(32), ..device_config() });
    until_width(32);
    assert_eq!(openings.try_iter().count(), 1, "opened once");
}

#[test]
fn another_configuration_is_taken_over_where_nothing_must_be_opened_anew() {
    let (setup, _woken) = live();
    let device = |more: serde_json::Value| {
        let mut config = json!({"source": "/dev/no-such-camera"});
        config.as_object_mut().expect("a map").extend(more.as_object().expect("a map").clone());
        serde_json::from_value::<CameraConfig>(config).expect("valid")
    };
    let mut camera = Camera::new(device(json!({})), &setup).expect("it may come later");
    assert!(Camera::exclusive(&camera.config), "a device can be opened once");
    assert!(
        camera.reconfigure(&device(json!({"width": 320, "height": 240, "rate_hz": 15}))).is_some(),
        "size and rate"
    );
    assert!(camera.reconfigure(&device(json!({}))).is_none(), "its own size is known only at its opening");
    assert!(camera.reconfigure(&device(json!({"source": "/dev/other"}))).is_none(), "another device");
}

#[test]
fn a_state_of_version_1_was_the_position_alone() {
    let bytes = carril_messages::codec::encode(&7_u64).expect("a number has bytes");
    let state = Camera::migrate(1, &bytes).expect("version 1 is known");
    assert_eq!(state, CameraState { position: 7, any_good: true, ended: false }, "in the middle of its source");
    assert!(Camera::migrate(1, &[]).is_err(), "no bytes are no position");
    let refused = Camera::migrate(3, &bytes).expect_err("a version to come").to_string();
    assert!(refused.contains("version 3, `camera` takes versions 1 and 2"), "{refused}");
}
