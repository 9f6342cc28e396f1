//! A file with the text that it shall have: prepared before anything changes, then replaced in one step.

use std::fs::{self, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use thiserror::Error;

use super::EditError;

/// Why a file keeps the text that it has.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum FileChangeError {
    /// It cannot be read.
    #[error("cannot read `{}`: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// The change cannot be written into its text.
    #[error("not saved: {}: {source}", path.display())]
    Edit {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: EditError,
    },
    /// Somebody else has written it since it was read.
    #[error("not saved: somebody has changed `{}` meanwhile; repeat the command", path.display())]
    Changed {
        /// The file.
        path: PathBuf,
    },
    /// It cannot be written.
    #[error("not saved: cannot write `{}`: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
}

/// A file with the text that it shall have. Nothing is written before [`save`](Self::save).
pub struct FileChange {
    path: PathBuf,
    /// `None`: it is not there yet.
    before: Option<String>,
    after: String,
}

impl FileChange {
    /// Changes the text of a file that is there.
    pub fn prepare(
        path: &Path,
        change: impl FnOnce(&str) -> Result<String, EditError>,
    ) -> Result<Self, FileChangeError> {
        let read = |source| FileChangeError::Read { path: path.to_owned(), source };
        let (path, before) = (fs::canonicalize(path), fs::read_to_string(path));
        // A link stays a link.
        let (path, before) = (path.map_err(read)?, before.map_err(read)?);
        Self::with(path, Some(before), |text| change(text.unwrap_or_default()))
    }

    /// Changes the text of a file, or makes it.
    pub fn prepare_or_create(
        path: &Path,
        change: impl FnOnce(Option<&str>) -> Result<String, EditError>,
    ) -> Result<Self, FileChangeError> {
        match (fs::canonicalize(path), fs::read_to_string(path)) {
            (Ok(path), Ok(before)) => Self::with(path, Some(before), change),
            (Err(error), _) if error.kind() == io::ErrorKind::NotFound => Self::with(path.to_owned(), None, change),
            (Err(source), _) | (_, Err(source)) => Err(FileChangeError::Read { path: path.to_owned(), source }),
        }
    }

    fn with(
        path: PathBuf,
        before: Option<String>,
        change: impl FnOnce(Option<&str>) -> Result<String, EditError>,
    ) -> Result<Self, FileChangeError> {
        match change(before.as_deref()) {
            Ok(after) => Ok(Self { path, before, after }),
            Err(source) => Err(FileChangeError::Edit { path, source }),
        }
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The text that it shall have.
    pub fn after(&self) -> &str {
        &self.after
    }

    /// Replaces the file in one step; its mode stays. Refused when somebody else has changed it meanwhile.
    pub fn save(&self) -> Result<(), FileChangeError> {
        let now = match fs::read_to_string(&self.path) {
            Ok(text) => Some(text),
            Err(error) if error.kind() == io::ErrorKind::NotFound => None,
            Err(source) => return Err(FileChangeError::Read { path: self.path.clone(), source }),
        };
        if now != self.before {
            return Err(FileChangeError::Changed { path: self.path.clone() });
        }
        if self.before.as_ref() == Some(&self.after) {
            return Ok(());
        }
        let name = self.path.file_name().unwrap_or_default().to_string_lossy();
        let fresh = self.path.with_file_name(format!(".{name}.{}", std::process::id()));
        let written = self.write(&fresh).and_then(|()| fs::rename(&fresh, &self.path));
        if written.is_err() {
            // It may not even have been made.
            let _ = fs::remove_file(&fresh);
        }
        written.map_err(|source| FileChangeError::Write { path: self.path.clone(), source })
    }

    fn write(&self, fresh: &Path) -> io::Result<()> {
        let mut file = OpenOptions::new().write(true).create_new(true).open(fresh)?;
        if self.before.is_some() {
            file.set_permissions(fs::metadata(&self.path)?.permissions())?;
        }
        file.write_all(self.after.as_bytes())?;
        file.sync_all()
    }
}
