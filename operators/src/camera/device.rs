//! Frames from a camera. A thread of its own waits for them, stamps them, and opens the device again and again when it is gone.

use std::sync::mpsc::{self, Receiver, RecvTimeoutError, Sender};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

use carril_messages::{Image, Stamp};
use carril_runtime::Setup;
use opencv::prelude::*;
use opencv::videoio::{self, VideoCapture};

use super::config::CameraConfig;
use super::pixels::{Converter, Lend, text};

/// Pause before the first attempt to open a device again; doubles up to [`LONGEST_PAUSE`].
const FIRST_PAUSE: Duration = Duration::from_millis(100);
/// A device that was plugged in again is back after this at the latest.
const LONGEST_PAUSE: Duration = Duration::from_secs(2);
/// How long the end of the node waits for the thread to let go of the device.
const FAREWELL: Duration = Duration::from_millis(500);

/// A camera that is open. Behind it stands OpenCV, or a fake in tests.
pub(crate) trait Grabber {
    /// Waits for the next frame; `false` when the device is gone.
    fn grab(&mut self) -> bool;
    /// Asks for another size, rate or encoding. A device does what it can, and each frame says its own size.
    fn configure(&mut self, config: &CameraConfig);
    /// The frame that was grabbed.
    fn retrieve(&mut self, lend: Lend<'_>) -> Result<Image, String>;
}

/// Opens a camera, or says why not.
pub(crate) type Opener = Box<dyn FnMut(&CameraConfig) -> Result<Box<dyn Grabber>, String> + Send>;

/// What the thread hands to the node.
#[derive(Debug, Default)]
pub(crate) struct Handover {
    /// The newest frame and when it was grabbed.
    pub frame: Option<(Image, Stamp)>,
    /// What went wrong since the node last looked.
    pub trouble: Option<String>,
    /// How often the device came back.
    pub reconnects: u64,
}

/// The thread of a camera. It ends when this is dropped.
pub(crate) struct DeviceThread {
    handover: Arc<Mutex<Handover>>,
    config: Arc<Mutex<CameraConfig>>,
    stop: Option<Sender<()>>,
    ended: Receiver<()>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl DeviceThread {
    /// Begins to grab.
    pub(crate) fn start(name: String, config: CameraConfig, open: Opener, setup: &Setup) -> Result<Self, String> {
        let config = Arc::new(Mutex::new(config));
        let handover = Arc::new(Mutex::new(Handover::default()));
        let (stop, stopped) = mpsc::channel();
        let (end, ended) = mpsc::channel();
        let (setup, shared) = (setup.clone(), (Arc::clone(&config), Arc::clone(&handover)));
        let node = setup.node.clone();
        let driver = Driver { name, open, setup, config: shared.0, handover: shared.1, stopped };
        thread::Builder::new()
            .name(format!("camera {node}"))
            .spawn(move || {
                driver.run();
                // The node may no longer wait.
                let _ = end.send(());
            })
            .map_err(|error| format!("cannot start the camera's thread: {error}"))?;
        Ok(Self { handover, config, stop: Some(stop), ended })
    }

    /// Asks for another size, rate or encoding, from the next frame on. The device stays open.
    pub(crate) fn configure(&self, config: &CameraConfig) {
        config.clone_into(&mut lock(&self.config));
    }

    /// What has come since the last call.
    pub(crate) fn take(&self) -> Handover {
        let mut handover = lock(&self.handover);
        let reconnects = handover.reconnects;
        std::mem::replace(&mut *handover, Handover { reconnects, ..Handover::default() })
    }
}

impl Drop for DeviceThread {
    fn drop(&mut self) {
        self.stop = None;
        // A device that hangs keeps its thread; the node ends all the same.
        let _ = self.ended.recv_timeout(FAREWELL);
    }
}

struct Driver {
    name: String,
    open: Opener,
    setup: Setup,
    config: Arc<Mutex<CameraConfig>>,
    handover: Arc<Mutex<Handover>>,
    stopped: Receiver<()>,
}

impl Driver {
    fn run(mut self) {
        let mut pause = FIRST_PAUSE;
        let (mut opened_before, mut attempts, mut outage) = (false, 0_u64, false);
        loop {
            let config = lock(&self.config).clone();
            let reason = match (self.open)(&config) {
                Ok(mut device) => {
                    if self.grab_all(device.as_mut(), config, &mut opened_before, attempts) {
                        (pause, attempts, outage) = (FIRST_PAUSE, 0, false);
                    }
                    "stopped delivering frames".to_owned()
                }
                Err(reason) => reason,
            };
            attempts += 1;
            if !outage {
                outage = true;
                self.report(format!("camera `{}`: {reason}; tries again until it is back", self.name));
            }
            if self.stop_within(pause) {
                return;
            }
            pause = (2 * pause).min(LONGEST_PAUSE);
        }
    }

    /// Hands over frames until the device is gone or the node ends; whether any came.
    fn grab_all(
        &mut self,
        device: &mut dyn Grabber,
        mut config: CameraConfig,
        opened_before: &mut bool,
        attempts: u64,
    ) -> bool {
        let mut any = false;
        while !self.stop_within(Duration::ZERO) {
            let wanted = lock(&self.config).clone();
            if wanted != config {
                device.configure(&wanted);
                config = wanted;
            }
            if !device.grab() {
                break;
            }
            let captured = self.setup.clock.now();
            match device.retrieve(&|len| self.setup.buffers.buffer(len)) {
                Ok(image) => {
                    if !any && *opened_before {
                        tracing::info!(camera = %self.name, attempts, "the camera is back");
                        lock(&self.handover).reconnects += 1;
                    }
                    (any, *opened_before) = (true, true);
                    lock(&self.handover).frame = Some((image, captured));
                    self.setup.waker.wake();
                }
                Err(damage) => self.report(format!("camera `{}`: {damage}", self.name)),
            }
        }
        any
    }

    fn report(&self, trouble: String) {
        lock(&self.handover).trouble = Some(trouble);
        self.setup.waker.wake();
    }

    /// Waits; `true` when the node has ended meanwhile.
    fn stop_within(&self, pause: Duration) -> bool {
        !matches!(self.stopped.recv_timeout(pause), Err(RecvTimeoutError::Timeout))
    }
}

/// Opens real devices through OpenCV.
pub(crate) fn opencv_opener(device: String) -> Opener {
    Box::new(move |config| {
        let failed = |reason: String| format!("cannot be opened{reason}");
        let mut capture = VideoCapture::from_file(&device, videoio::CAP_V4L2)
            .map_err(|error| failed(format!(": {}", text(error))))?;
        // OpenCV gives a capture that is not open instead of an error.
        if !capture.is_opened().unwrap_or(false) {
            return Err(failed(String::new()));
        }
        // One buffer, because only the newest frame counts. A device that cannot do that has more.
        let _ = capture.set(videoio::CAP_PROP_BUFFERSIZE, 1.0);
        let mut device = OpenCvDevice { capture, config: config.clone(), converter: Converter::default() };
        device.configure(config);
        Ok(Box::new(device))
    })
}

struct OpenCvDevice {
    capture: VideoCapture,
    config: CameraConfig,
    converter: Converter,
}

impl Grabber for OpenCvDevice {
    fn grab(&mut self) -> bool {
        self.capture.grab().unwrap_or(false)
    }

    fn configure(&mut self, config: &CameraConfig) {
        // Wishes: a device that cannot fulfil them delivers what it can.
        let mut wish = |property, value| drop(self.capture.set(property, value));
        if let Some((width, height)) = config.size() {
            wish(videoio::CAP_PROP_FRAME_WIDTH, f64::from(width));
            wish(videoio::CAP_PROP_FRAME_HEIGHT, f64::from(height));
        }
        wish(videoio::CAP_PROP_FPS, config.rate_hz);
        config.clone_into(&mut self.config);
    }

    fn retrieve(&mut self, lend: Lend<'_>) -> Result<Image, String> {
        self.converter.retrieve(&mut self.capture, self.config.encoding, None, lend)
    }
}
