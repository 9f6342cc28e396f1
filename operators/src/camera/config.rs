//! The configuration of the camera, and what its `source` means.

use std::path::{Path, PathBuf};

use carril_messages::Encoding;
use carril_runtime::{Findings, OperatorConfig};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Files that count as images in a folder.
const IMAGE_SUFFIXES: [&str; 9] = ["png", "jpg", "jpeg", "bmp", "pgm", "ppm", "tif", "tiff", "webp"];

/// Configuration of the camera.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CameraConfig {
    /// A device (`/dev/video0`), a video file, a folder of images (in the order of their names), or a pattern for images in a
    /// folder (`frames/*.png`, `frames/%04d.png`). Relative paths begin at the folder of the graph file.
    pub source: String,
    /// Width of the frames, px, 16 to 4096, together with `height`. A device is asked for it; files are scaled to it. Without it,
    /// frames have the size of the source.
    #[serde(default)]
    #[schemars(range(min = 16, max = 4096), extend("unit" = "px"))]
    pub width: Option<u32>,
    /// Height of the frames, px, 16 to 4096, together with `width`.
    #[serde(default)]
    #[schemars(range(min = 16, max = 4096), extend("unit" = "px"))]
    pub height: Option<u32>,
    /// Frames per second, Hz, 0.1 to 240. A device is asked for it; files are played at it.
    #[serde(default = "default_rate_hz")]
    #[schemars(range(min = 0.1, max = 240), extend("unit" = "Hz"))]
    pub rate_hz: f64,
    /// Begin a file or folder again when it has ended.
    #[serde(default, rename = "loop")]
    pub repeat: bool,
    /// How pixels lie in memory: `bgr8`, `rgb8` or `mono8`.
    #[serde(default = "default_encoding")]
    pub encoding: Encoding,
}

fn default_rate_hz() -> f64 {
    30.0
}

fn default_encoding() -> Encoding {
    Encoding::Bgr8
}

/// What a source is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Source {
    /// A camera.
    Device(String),
    /// A video.
    Video(PathBuf),
    /// Images, in order.
    Images(Vec<PathBuf>),
}

impl CameraConfig {
    /// Files in the size that they have.
    pub(crate) fn of_files(source: &str) -> Self {
        let (rate_hz, encoding) = (default_rate_hz(), default_encoding());
        Self { source: source.to_owned(), width: None, height: None, rate_hz, repeat: false, encoding }
    }

    /// Whether the source is a camera, by its name alone.
    pub(crate) fn is_device(&self) -> bool {
        device_path(&self.source).is_some()
    }

    /// Finds out what the source is, and which images it has.
    pub(crate) fn resolve(&self, base_dir: &Path) -> Result<Source, String> {
        if let Some(device) = device_path(&self.source) {
            return Ok(Source::Device(device));
        }
        let path = base_dir.join(&self.source);
        if let Some(pattern) = Pattern::of(&path) {
            let folder = path.parent().unwrap_or(Path::new("."));
            let images = pattern.matches(folder)?;
            let none = || format!("no file matches `{}`", path.display());
            return if images.is_empty() { Err(none()) } else { Ok(Source::Images(images)) };
        }
        if path.is_dir() {
            let images = images_in(&path)?;
            let none = || format!("the folder `{}` holds no images ({})", path.display(), IMAGE_SUFFIXES.join(", "));
            return if images.is_empty() { Err(none()) } else { Ok(Source::Images(images)) };
        }
        if !path.is_file() {
            return Err(format!("`{}` does not exist", path.display()));
        }
        Ok(if is_image(&path) { Source::Images(vec![path]) } else { Source::Video(path) })
    }

    /// The size that frames shall have.
    pub(crate) fn size(&self) -> Option<(u32, u32)> {
        self.width.zip(self.height)
    }
}

/// `/dev/video0`, or `0` for short.
fn device_path(source: &str) -> Option<String> {
    if !source.is_empty() && source.bytes().all(|byte| byte.is_ascii_digit()) {
        return Some(format!("/dev/video{source}"));
    }
    source.starts_with("/dev/").then(|| source.to_owned())
}

fn is_image(path: &Path) -> bool {
    let suffix = path.extension().and_then(|suffix| suffix.to_str()).unwrap_or_default();
    IMAGE_SUFFIXES.iter().any(|known| known.eq_ignore_ascii_case(suffix))
}

fn images_in(folder: &Path) -> Result<Vec<PathBuf>, String> {
    let mut images: Vec<_> = files_in(folder)?.into_iter().filter(|path| is_image(path)).collect();
    images.sort();
    Ok(images)
}

fn files_in(folder: &Path) -> Result<Vec<PathBuf>, String> {
    let entries = folder.read_dir().map_err(|error| format!("cannot read folder `{}`: {error}", folder.display()))?;
    Ok(entries.flatten().map(|entry| entry.path()).filter(|path| path.is_file()).collect())
}

/// A file name with one placeholder: `*` (anything) or `%d`, `%04d` (a number).
#[derive(Clone, Debug, PartialEq, Eq)]
struct Pattern {
    before: String,
    after: String,
    number: bool,
}

impl Pattern {
    fn of(path: &Path) -> Option<Self> {
        let name = path.file_name()?.to_str()?;
        if let Some((before, after)) = name.split_once('*') {
            return Some(Self { before: before.into(), after: after.into(), number: false });
        }
        let (before, rest) = name.split_once('%')?;
        let after = rest.trim_start_matches(|c: char| c.is_ascii_digit()).strip_prefix('d')?;
        Some(Self { before: before.into(), after: after.into(), number: true })
    }

    /// The files that match, numbers in the order of their values, names in alphabetical order.
    fn matches(&self, folder: &Path) -> Result<Vec<PathBuf>, String> {
        let mut found: Vec<(Option<u64>, PathBuf)> = Vec::new();
        for path in files_in(folder)? {
            let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
            let middle = name.strip_prefix(&self.before).and_then(|rest| rest.strip_suffix(&self.after));
            match middle.map(str::parse::<u64>) {
                Some(Ok(number)) if self.number => found.push((Some(number), path)),
                Some(_) if !self.number => found.push((None, path)),
                _ => {}
            }
        }
        found.sort();
        Ok(found.into_iter().map(|(_, path)| path).collect())
    }
}

impl OperatorConfig for CameraConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        findings.range("rate_hz", self.rate_hz, 0.1, 240.0, "Hz");
        for (field, value) in [("width", self.width), ("height", self.height)] {
            if let Some(value) = value {
                findings.range(field, f64::from(value), 16.0, 4096.0, "px");
            }
        }
        let given = if self.width.is_some() { "width" } else { "height" };
        findings.require(self.width.is_some() == self.height.is_some(), given, || {
            format!("got only `{given}`, allowed is both `width` and `height`, or neither")
        });
        if let Some(device) = device_path(&self.source) {
            findings.device("source", &device);
        } else if let Err(problem) = self.resolve(findings.base_dir()) {
            let hint = "a device (`/dev/video0`), a video file, a folder of images or a pattern (`frames/*.png`); paths begin \
                        at the folder of the graph file";
            findings.report("source", problem, Some(hint.into()));
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use serde_json::json;

    use super::*;
    use crate::camera::Camera;
    use crate::testing::problems;

    fn config(source: &str) -> CameraConfig {
        serde_json::from_value(json!({ "source": source })).expect("a valid configuration")
    }

    fn names(source: Result<Source, String>) -> Vec<String> {
        let Ok(Source::Images(paths)) = source else { panic!("no images: {source:?}") };
        paths.iter().map(|path| path.file_name().expect("a name").to_string_lossy().into_owned()).collect()
    }

    #[test]
    fn tells_devices_videos_folders_and_patterns_apart() {
        let folder = tempfile::tempdir().expect("a folder");
        for name in ["b.png", "a.JPG", "notes.txt", "f2.png", "f10.png", "f.mp4"] {
            fs::write(folder.path().join(name), []).expect("a file");
        }
        let resolve = |source: &str| config(source).resolve(folder.path());
        assert_eq!(resolve("/dev/video3"), Ok(Source::Device("/dev/video3".into())), "by its path");
        assert_eq!(resolve("0"), Ok(Source::Device("/dev/video0".into())), "by its number");
        assert_eq!(resolve("f.mp4"), Ok(Source::Video(folder.path().join("f.mp4"))), "a video");
        assert_eq!(names(resolve("b.png")), ["b.png"], "one image");
        assert_eq!(names(resolve(".")), ["a.JPG", "b.png", "f10.png", "f2.png"], "a folder, by name");
        assert_eq!(names(resolve("*.png")), ["b.png", "f10.png", "f2.png"], "a pattern, by name");
        assert_eq!(names(resolve("f%d.png")), ["f2.png", "f10.png"], "numbers, by value");
        assert_eq!(names(resolve("f%02d.png")), ["f2.png", "f10.png"], "with or without leading zeros");
    }

    #[test]
    fn says_what_is_missing() {
        let folder = tempfile::tempdir().expect("a folder");
        let error = |source: &str| config(source).resolve(folder.path()).expect_err("nothing is there");
        assert!(error(".").contains("holds no images (png, jpg"), "{}", error("."));
        assert!(error("*.png").contains("no file matches"), "{}", error("*.png"));
        assert!(error("drive.mp4").ends_with("drive.mp4` does not exist"), "{}", error("drive.mp4"));
        assert!(error("none/*.png").contains("cannot read folder"), "{}", error("none/*.png"));
    }

    #[test]
    fn every_bound_is_checked() {
        for (config, field) in [
            (json!({"source": "/dev/video0", "rate_hz": 0}), "rate_hz"),
            (json!({"source": "/dev/video0", "rate_hz": 241}), "rate_hz"),
            (json!({"source": "/dev/video0", "width": 15, "height": 100}), "width"),
            (json!({"source": "/dev/video0", "width": 100, "height": 4097}), "height"),
            (json!({"source": "/dev/video0", "width": 100}), "width"),
            (json!({"source": "/dev/video0", "height": 100}), "height"),
            (json!({"source": "no-such-file.mp4"}), "source"),
            (json!({"source": "/dev/video0", "encoding": "yuv"}), "encoding"),
            (json!({}), ""),
        ] {
            let found = problems::<Camera>(&config);
            assert!(found.len() == 1 && found[0].starts_with(&format!("{field}: ")), "{config}: {found:?}");
        }
        let nan = CameraConfig { rate_hz: f64::NAN, ..config("/dev/video0") };
        assert_eq!(crate::testing::fields_found(&nan), ["rate_hz"], "no number");
    }

    #[test]
    fn a_missing_device_is_found_only_when_devices_are_probed() {
        let config = config("/dev/no-such-camera");
        for (probe, count) in [(false, 0), (true, 1)] {
            let mut findings = Findings::new(Path::new("."), probe);
            config.check(&mut findings);
            let found = findings.into_found();
            assert_eq!(found.len(), count, "probed: {probe}: {found:?}");
        }
    }
}
