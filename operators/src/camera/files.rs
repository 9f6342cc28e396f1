//! Frames from files: a video or images in order. Read synchronously, step by step, so that a replay is the same each time.

use std::path::{Path, PathBuf};

use carril_messages::{Image, PayloadMut};
use opencv::imgcodecs;
use opencv::prelude::*;
use opencv::videoio::{self, VideoCapture};

use super::CameraState;
use super::config::{CameraConfig, Source};
use super::pixels::{Converter, Lend, text};

/// Why there is no frame.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum NoFrame {
    /// This one is damaged; the next may be good.
    Damaged(String),
    /// No more comes, and why.
    Ended(String),
    /// Already said that no more comes.
    Silent,
}

/// Frames from files.
pub(crate) struct Files {
    frames: Frames,
    converter: Converter,
    /// Frames taken since the beginning of this pass, damaged ones included.
    position: u64,
    /// A frame of this pass was good: without one, beginning again would never end.
    any_good: bool,
    ended: bool,
}

enum Frames {
    Video { path: PathBuf, capture: VideoCapture },
    Images(Vec<PathBuf>),
}

impl Files {
    /// Opens a source that is no device.
    pub(crate) fn open(source: Source) -> Result<Self, String> {
        let frames = match source {
            Source::Images(paths) => Frames::Images(paths),
            Source::Video(path) => Frames::Video { capture: open_video(&path)?, path },
            Source::Device(device) => return Err(format!("`{device}` is a device, not a file")),
        };
        Ok(Self { frames, converter: Converter::default(), position: 0, any_good: false, ended: false })
    }

    /// Where a successor goes on.
    pub(crate) fn state(&self) -> CameraState {
        CameraState { position: self.position, any_good: self.any_good, ended: self.ended }
    }

    /// Goes on where a predecessor has stopped.
    pub(crate) fn restore(&mut self, state: CameraState) -> Result<(), String> {
        self.seek(state.position)?;
        (self.any_good, self.ended) = (state.any_good, state.ended);
        Ok(())
    }

    fn seek(&mut self, position: u64) -> Result<(), String> {
        if let Frames::Video { path, capture } = &mut self.frames {
            *capture = open_video_at(path, position)?;
        }
        self.position = position;
        Ok(())
    }

    /// The next frame.
    pub(crate) fn next(&mut self, config: &CameraConfig, lend: Lend<'_>) -> Result<Image, NoFrame> {
        if self.ended {
            return Err(NoFrame::Silent);
        }
        match self.advance(config, lend) {
            Some(Ok(image)) => {
                self.any_good = true;
                Ok(image)
            }
            Some(Err(damage)) => Err(NoFrame::Damaged(damage)),
            None if config.repeat && self.any_good => {
                self.any_good = false;
                self.seek(0).map_err(NoFrame::Damaged)?;
                self.next(config, lend)
            }
            None => {
                self.ended = true;
                Err(NoFrame::Ended(self.ending(config)))
            }
        }
    }

    /// The next frame of this pass, or what is wrong with it; `None` at the end.
    fn advance(&mut self, config: &CameraConfig, lend: Lend<'_>) -> Option<Result<Image, String>> {
        let frame = match &mut self.frames {
            Frames::Images(paths) => {
                let path = paths.get(usize::try_from(self.position).ok()?)?;
                read_image(path).and_then(|mat| self.converter.convert(&mat, config.encoding, config.size(), lend))
            }
            Frames::Video { capture, .. } => {
                // A damaged video and one that has ended look the same to OpenCV: nothing more can be grabbed.
                if !capture.grab().unwrap_or(false) {
                    return None;
                }
                self.converter.retrieve(capture, config.encoding, config.size(), lend)
            }
        };
        self.position += 1;
        let number = self.position;
        Some(frame.map_err(|damage| format!("frame {number} of `{}`: {damage}", config.source)))
    }

    fn ending(&self, config: &CameraConfig) -> String {
        let (source, taken) = (&config.source, self.position);
        let promised = match &self.frames {
            Frames::Images(paths) => paths.len() as u64,
            Frames::Video { capture, .. } => capture.get(videoio::CAP_PROP_FRAME_COUNT).map_or(0, |count| count as u64),
        };
        if !self.any_good {
            format!("`{source}` gave no frame that can be decoded; the camera stays silent")
        } else if taken < promised {
            format!(
                "`{source}` broke off after {taken} of {promised} frames: it may be damaged; the camera stays silent"
            )
        } else {
            format!("`{source}` has ended after {taken} frames; the camera stays silent (`loop: true` begins it again)")
        }
    }
}

fn open_video(path: &Path) -> Result<VideoCapture, String> {
    let unreadable = |reason: String| format!("`{}` cannot be read as a video{reason}", path.display());
    // Where OpenCV has FFmpeg, a file that FFmpeg refuses is damaged: the other backends would only take longer to say so.
    let has_ffmpeg = videoio::has_backend(videoio::VideoCaptureAPIs::CAP_FFMPEG).unwrap_or(false);
    let backend = if has_ffmpeg { videoio::CAP_FFMPEG } else { videoio::CAP_ANY };
    let capture = VideoCapture::from_file(path, backend).map_err(|error| unreadable(format!(": {}", text(error))))?;
    // OpenCV gives a capture that is not open instead of an error.
    if capture.is_opened().unwrap_or(false) { Ok(capture) } else { Err(unreadable(String::new())) }
}

/// Opens a video at a frame: by a jump where the container allows it, else by reading up to there.
fn open_video_at(path: &Path, position: u64) -> Result<VideoCapture, String> {
    let mut capture = open_video(path)?;
    if position == 0 {
        return Ok(capture);
    }
    let wanted = position as f64;
    let jumped = capture.set(videoio::CAP_PROP_POS_FRAMES, wanted).unwrap_or(false);
    if jumped && capture.get(videoio::CAP_PROP_POS_FRAMES).is_ok_and(|got| got == wanted) {
        return Ok(capture);
    }
    capture = open_video(path)?;
    for _ in 0..position {
        if !capture.grab().map_err(text)? {
            break;
        }
    }
    Ok(capture)
}

fn read_image(path: &Path) -> Result<Mat, String> {
    let unreadable = || format!("`{}` cannot be read as an image", path.display());
    let mat = imgcodecs::imread(path, imgcodecs::IMREAD_COLOR).map_err(|_| unreadable())?;
    if mat.empty() { Err(unreadable()) } else { Ok(mat) }
}

/// The frames of an image, a folder, a pattern or a video, as the camera would give them, one after another.
pub struct FrameFiles {
    config: CameraConfig,
    files: Files,
}

impl FrameFiles {
    /// Opens what a camera's `source` may be, but for a device. Relative paths begin at the working directory.
    pub fn open(source: &str) -> Result<Self, String> {
        super::silence_opencv();
        let config = CameraConfig::of_files(source);
        let files = Files::open(config.resolve(Path::new(""))?)?;
        Ok(Self { config, files })
    }
}

impl Iterator for FrameFiles {
    /// A frame, or what is wrong with it.
    type Item = Result<Image, String>;

    fn next(&mut self) -> Option<Self::Item> {
        self.files.advance(&self.config, &PayloadMut::heap)
    }
}
