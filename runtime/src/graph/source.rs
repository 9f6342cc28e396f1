//! The text of a graph file or a calibration file, and where its lines begin. Reads the file within limits; knows nothing of YAML.

use std::fs::File;
use std::io::Read;
use std::ops::Range;
use std::path::Path;

use super::problem::{Excerpt, Problem};

/// No graph file and no calibration file is larger, B. A graph of a thousand nodes has a quarter of it.
pub const MAX_FILE_BYTES: usize = 1 << 20;

/// What a file shall be, for messages.
#[derive(Clone, Copy)]
pub(crate) enum Kind {
    Graph,
    Calibration,
    Scenario,
}

impl Kind {
    fn name(self) -> &'static str {
        match self {
            Self::Graph => "a graph file",
            Self::Calibration => "a calibration file",
            Self::Scenario => "a scenario file",
        }
    }

    fn example(self) -> &'static str {
        match self {
            Self::Graph => "dataflow.yaml",
            Self::Calibration => "car1.calibration.yaml",
            Self::Scenario => "scenarios/lanes.yaml",
        }
    }
}

/// A text with the name that problems show.
pub(crate) struct Source {
    pub(crate) name: String,
    pub(crate) text: String,
    line_starts: Vec<usize>,
    /// Byte of each character; `None` when all are ASCII and both are the same.
    char_bytes: Option<Vec<usize>>,
}

impl Source {
    pub(crate) fn new(name: String, text: String) -> Self {
        let line_starts = std::iter::once(0).chain(text.match_indices('\n').map(|(at, _)| at + 1)).collect();
        let char_bytes = (!text.is_ascii()).then(|| text.char_indices().map(|(at, _)| at).collect());
        Self { name, text, line_starts, char_bytes }
    }

    /// Byte of the character at `index`; the end of the text when there is none.
    pub(crate) fn byte_of_char(&self, index: usize) -> usize {
        let byte = match &self.char_bytes {
            Some(bytes) => bytes.get(index).copied().unwrap_or(self.text.len()),
            None => index,
        };
        byte.min(self.text.len())
    }

    /// Line of a byte, from 1.
    pub(crate) fn line_of(&self, byte: usize) -> usize {
        self.line_starts.partition_point(|&at| at <= byte)
    }

    /// Line (from 1), column in characters (from 1), and the line itself with the part of `span` that lies in it.
    pub(crate) fn excerpt(&self, span: &Range<usize>) -> Excerpt {
        let start = span.start.min(self.text.len());
        let line = self.line_of(start);
        let line_start = self.line_starts[line - 1];
        let text = self.text[line_start..].split('\n').next().unwrap_or_default().trim_end_matches('\r');
        let in_line = |at: usize| {
            let at = at.saturating_sub(line_start).min(text.len());
            (at..=text.len()).find(|&at| text.is_char_boundary(at)).unwrap_or(text.len())
        };
        let (from, to) = (in_line(start), in_line(span.end));
        let to = from + text[from..to.max(from)].trim_end().len();
        let column = text[..from].chars().count() + 1;
        Excerpt { line, column, text: text.to_owned(), span: from..to }
    }
}

/// Reads a file of at most [`MAX_FILE_BYTES`] that is text.
pub(crate) fn read_text(path: &Path, kind: Kind) -> Result<String, Box<Problem>> {
    let name = path.display().to_string();
    let unreadable = |error: std::io::Error| {
        let hint = format!("give the path of {}, for example `{}`", kind.name(), kind.example());
        Box::new(Problem::of_file(&name, "unreadable-file", format!("cannot be read: {error}")).with_hint(hint))
    };
    let mut bytes = Vec::new();
    let file = File::open(path).map_err(unreadable)?;
    file.take(MAX_FILE_BYTES as u64 + 1).read_to_end(&mut bytes).map_err(unreadable)?;
    if bytes.len() > MAX_FILE_BYTES {
        let size = std::fs::metadata(path).map_or(bytes.len() as u64, |metadata| metadata.len());
        return Err(too_large(&name, size, kind).into());
    }
    check_bytes(&name, bytes, kind)
}

pub(crate) fn too_large(name: &str, size: u64, kind: Kind) -> Problem {
    let message = format!("the file has {size} B, {} has at most {MAX_FILE_BYTES} B", kind.name());
    Problem::of_file(name, "file-too-large", message)
        .with_hint("is it a recording? Those belong into a node's config, as a path")
}

fn check_bytes(name: &str, bytes: Vec<u8>, kind: Kind) -> Result<String, Box<Problem>> {
    let refuse = |at: usize, what: String| {
        let (line, column) = (bytes[..at].split(|&b| b == b'\n').count(), at - line_start(&bytes, at) + 1);
        let mut problem =
            Problem::of_file(name, "not-text", what).with_hint(format!("{} is YAML in UTF-8", kind.name()));
        (problem.line, problem.column) = (Some(line), Some(column));
        Box::new(problem)
    };
    if let Err(error) = std::str::from_utf8(&bytes) {
        let at = error.valid_up_to();
        return Err(refuse(at, format!("the file is no UTF-8 text: got byte 0x{:02x}", bytes[at])));
    }
    if let Some(at) = bytes.iter().position(|&b| b == 0) {
        return Err(refuse(at, "the file is no text: got a NUL byte".into()));
    }
    Ok(String::from_utf8(bytes).expect("checked above"))
}

fn line_start(bytes: &[u8], at: usize) -> usize {
    bytes[..at].iter().rposition(|&b| b == b'\n').map_or(0, |newline| newline + 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_columns_in_characters() {
        let source = Source::new("a.yaml".into(), "ä: 1\r\nöü: 2\n".into());
        let value = source.byte_of_char("ä: 1\r\nöü: ".chars().count());
        let excerpt = source.excerpt(&(value..value + 1));
        assert_eq!((excerpt.line, excerpt.column), (2, 5), "line and column of the 2");
        assert_eq!(&excerpt.text[excerpt.span], "2", "the span lies on it");
    }

    #[test]
    fn says_where_a_binary_file_is_no_text() {
        let problem = check_bytes("a.yaml", b"robot: x\nab\0".to_vec(), Kind::Graph).expect_err("NUL");
        assert_eq!((problem.line, problem.column), (Some(2), Some(3)), "{}", problem.message);
        let problem = check_bytes("a.yaml", vec![b'a', 0xff], Kind::Graph).expect_err("no UTF-8");
        assert!(problem.message.contains("0xff"), "{}", problem.message);
    }
}
