//! Operator `camera`: frames from a device, a video file or images. From files it reads one frame per period, synchronously, so
//! that it runs in lockstep too; a device has a thread of its own.

mod config;
mod device;
mod files;
mod pixels;
#[cfg(test)]
mod tests;

use std::time::Duration;

use carril_messages::{Image, codec};
use carril_runtime::{Context, NoInputs, Operator, Setup, SetupError, StateError, StepError, Trigger};
use serde::{Deserialize, Serialize};

pub use config::CameraConfig;
use config::Source;
use device::DeviceThread;
pub use files::FrameFiles;
use files::{Files, NoFrame};

carril_runtime::outputs! {
    /// What the camera gives.
    pub struct CameraOutputs {
        /// Frames. Each carries its own size.
        image: Image,
    }
}

/// Gives frames.
pub struct Camera {
    config: CameraConfig,
    feed: Feed,
}

enum Feed {
    Files(Files),
    Device(DeviceThread),
}

/// Where the camera is in its source.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct CameraState {
    /// Frames of a file or folder that were taken since its beginning.
    pub position: u64,
    /// A frame of this pass was good.
    pub any_good: bool,
    /// The end was reached, and said.
    pub ended: bool,
}

impl Camera {
    fn step_files(
        config: &CameraConfig,
        files: &mut Files,
        outputs: &mut CameraOutputs,
        context: &Context<'_>,
    ) -> Result<(), StepError> {
        if context.trigger() != Trigger::Period {
            return Ok(());
        }
        match files.next(config, &|len| context.buffer(len)) {
            Ok(image) => {
                outputs.image.send_captured(image, context.now());
                Ok(())
            }
            Err(NoFrame::Damaged(reason) | NoFrame::Ended(reason)) => Err(StepError::new(reason)),
            Err(NoFrame::Silent) => Ok(()),
        }
    }

    fn step_device(device: &DeviceThread, outputs: &mut CameraOutputs) -> Result<(), StepError> {
        let handover = device.take();
        if let Some((image, captured)) = handover.frame {
            outputs.image.send_captured(image, captured);
        }
        handover.trouble.map_or(Ok(()), |trouble| Err(StepError::new(trouble)))
    }
}

/// Errors come with their own words; OpenCV's log would tell each of them again on stderr. `OPENCV_LOG_LEVEL` brings it back.
fn silence_opencv() {
    if std::env::var_os("OPENCV_LOG_LEVEL").is_none() {
        // A library that cannot be silenced still works.
        let _ = opencv::core::set_log_level(opencv::core::LogLevel::LOG_LEVEL_SILENT);
    }
}

impl Operator for Camera {
    const KIND: &'static str = "camera";
    const SUMMARY: &'static str = "frames from a camera, a video file or a folder of images";

    /// 1: the position alone.
    const STATE_VERSION: u32 = 2;

    type Config = CameraConfig;
    type Inputs = NoInputs;
    type Outputs = CameraOutputs;
    type State = CameraState;

    fn new(config: CameraConfig, setup: &Setup) -> Result<Self, SetupError> {
        silence_opencv();
        let feed = match config.resolve(&setup.base_dir).map_err(SetupError::new)? {
            Source::Device(device) if setup.memory_lines.is_some() => {
                return Err(SetupError::new(format!(
                    "`{device}` is a device, which cannot run in lockstep; use a video file or a folder of images as \
                     `source`, or `sim-world` in its place"
                )));
            }
            Source::Device(device) => {
                let open = device::opencv_opener(device.clone());
                Feed::Device(DeviceThread::start(device, config.clone(), open, setup).map_err(SetupError::new)?)
            }
            files => Feed::Files(Files::open(files).map_err(SetupError::new)?),
        };
        Ok(Self { config, feed })
    }

    fn step(
        &mut self,
        _inputs: &mut NoInputs,
        outputs: &mut CameraOutputs,
        context: &Context<'_>,
    ) -> Result<(), StepError> {
        match &mut self.feed {
            Feed::Files(files) => Self::step_files(&self.config, files, outputs, context),
            Feed::Device(device) => Self::step_device(device, outputs),
        }
    }

    fn period(config: &CameraConfig) -> Option<Duration> {
        let rate_is_sane = config.rate_hz >= 0.1 && config.rate_hz <= 240.0;
        (rate_is_sane && !config.is_device()).then(|| Duration::from_secs_f64(1.0 / config.rate_hz))
    }

    fn snapshot(&self) -> CameraState {
        match &self.feed {
            Feed::Files(files) => files.state(),
            Feed::Device(_) => CameraState::default(),
        }
    }

    fn restore(&mut self, state: CameraState) -> Result<(), StateError> {
        match &mut self.feed {
            Feed::Files(files) => files.restore(state).map_err(StateError::new),
            Feed::Device(_) => Ok(()),
        }
    }

    fn migrate(version: u32, state: &[u8]) -> Result<CameraState, StateError> {
        if version != 1 {
            let (kind, own) = (Self::KIND, Self::STATE_VERSION);
            return Err(StateError::new(format!(
                "the state has version {version}, `{kind}` takes versions 1 and {own}"
            )));
        }
        let position = codec::decode(state).map_err(StateError::new)?;
        Ok(CameraState { position, any_good: position > 0, ended: false })
    }

    /// A device can be opened once.
    fn exclusive(config: &CameraConfig) -> bool {
        config.is_device()
    }

    fn reconfigure(&mut self, config: &CameraConfig) -> Option<Result<(), SetupError>> {
        // A device that is to forget its size must be opened anew.
        let forgets_size = config.size().is_none() && self.config.size().is_some();
        if config.source != self.config.source || (config.is_device() && forgets_size) {
            return None;
        }
        if let Feed::Device(device) = &self.feed {
            device.configure(config);
        }
        self.config = config.clone();
        Some(Ok(()))
    }
}
