//! Standard output: lines, JSON lines and tables. A reader that went away (`| head`) ends the program quietly: every write
//! returns [`ClosedPipe`] then, and `main` turns it into success.

use std::fmt;
use std::io::{self, IsTerminal, Write};

use anyhow::{Context, Result};
use serde::Serialize;

/// Whoever read our output has gone.
#[derive(Debug)]
pub struct ClosedPipe;

impl fmt::Display for ClosedPipe {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("the reader of the output has gone")
    }
}

impl std::error::Error for ClosedPipe {}

/// Writes a line to standard output, at once.
pub fn line(text: impl fmt::Display) -> Result<()> {
    let mut stdout = io::stdout().lock();
    checked(writeln!(stdout, "{text}").and_then(|()| stdout.flush()))
}

/// Writes text that brings its own line ends.
pub fn text(text: impl fmt::Display) -> Result<()> {
    let mut stdout = io::stdout().lock();
    checked(write!(stdout, "{text}").and_then(|()| stdout.flush()))
}

/// Writes a value as one line of JSON.
pub fn json_line(value: &impl Serialize) -> Result<()> {
    line(serde_json::to_string(value).context("cannot write the result as JSON")?)
}

/// Writes a value as JSON that people can read too.
pub fn json(value: &impl Serialize) -> Result<()> {
    line(serde_json::to_string_pretty(value).context("cannot write the result as JSON")?)
}

fn checked(written: io::Result<()>) -> Result<()> {
    match written {
        Ok(()) => Ok(()),
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Err(ClosedPipe.into()),
        Err(error) => Err(error).context("cannot write to standard output"),
    }
}

/// A line that is written over and over in a terminal, and simply line by line into a pipe.
pub struct StatusLine {
    terminal: bool,
    width: usize,
}

impl StatusLine {
    /// For standard output as it is.
    pub fn new() -> Self {
        Self { terminal: io::stdout().is_terminal(), width: 0 }
    }

    /// Shows `text` in place of what was shown before.
    pub fn show(&mut self, text: &str) -> Result<()> {
        if !self.terminal {
            return line(text);
        }
        let columns = ratatui::crossterm::terminal::size().map_or(80, |(columns, _)| usize::from(columns));
        let shown: String = text.chars().take(columns.saturating_sub(1)).collect();
        let width = shown.chars().count();
        let padding = " ".repeat(self.width.saturating_sub(width));
        self.width = width;
        self::text(format_args!("\r{shown}{padding}"))
    }

    /// Ends the line, so that what follows begins on a new one.
    pub fn end(&mut self) -> Result<()> {
        if self.terminal && self.width > 0 {
            self.width = 0;
            return line("");
        }
        Ok(())
    }
}

/// A table whose columns are as wide as they must be. Columns whose name begins with `>` stand to the right.
pub fn table(columns: &[&str], rows: &[Vec<String>]) -> String {
    let names: Vec<String> = columns.iter().map(|name| name.trim_start_matches('>').to_owned()).collect();
    let lines: Vec<&Vec<String>> = std::iter::once(&names).chain(rows).collect();
    let width = |column: usize| lines.iter().map(|cells| cells[column].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..columns.len()).map(width).collect();
    let mut table = String::new();
    for cells in lines {
        let mut text = String::new();
        for (column, cell) in cells.iter().enumerate() {
            let width = widths[column];
            let right = columns[column].starts_with('>');
            text += &if right { format!("{cell:>width$}  ") } else { format!("{cell:<width$}  ") };
        }
        table += text.trim_end();
        table.push('\n');
    }
    table
}

/// A table without names of columns, indented; "none" when it is empty.
pub fn rows(rows: &[Vec<String>]) -> String {
    let Some(first) = rows.first() else { return "  none\n".to_owned() };
    let table = table(&vec![""; first.len()], rows);
    table.lines().skip(1).map(|line| format!("  {line}\n")).collect()
}

/// Lines of at most 100 characters, each behind `indent` blanks. Empty text gives nothing.
pub fn wrapped(text: &str, indent: usize) -> String {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        match lines.last_mut() {
            Some(line) if line.chars().count() + 1 + word.chars().count() <= 100 - indent => {
                *line += &format!(" {word}")
            }
            _ => lines.push(word.to_owned()),
        }
    }
    lines.iter().map(|line| format!("{:indent$}{line}\n", "")).collect()
}

/// Bytes in the unit that suits them: `900 B`, `921.6 kB`, `27.6 MB`.
pub fn bytes(count: f64) -> String {
    match count {
        count if count < 1e3 => format!("{count:.0} B"),
        count if count < 1e6 => format!("{:.1} kB", count / 1e3),
        count if count < 1e9 => format!("{:.1} MB", count / 1e6),
        count => format!("{:.2} GB", count / 1e9),
    }
}

/// `1 sample`, `2 samples`, `3 processes`
pub fn counted(count: u64, noun: &str) -> String {
    match (count, noun.ends_with('s')) {
        (1, _) => format!("1 {noun}"),
        (count, true) => format!("{count} {noun}es"),
        (count, false) => format!("{count} {noun}s"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_lines_up() {
        let rows = vec![vec!["world/camera".into(), "30.0".into()], vec!["lane/lane".into(), "9.8".into()]];
        let expected = "PORT            HZ\nworld/camera  30.0\nlane/lane      9.8\n";
        assert_eq!(table(&["PORT", ">HZ"], &rows), expected, "names to the left, numbers to the right");
    }

    #[test]
    fn long_text_is_wrapped_between_words() {
        let text = wrapped(&"word ".repeat(40), 6);
        assert!(text.lines().count() == 3 && text.lines().all(|line| line.len() <= 100), "{text}");
        assert_eq!(wrapped("", 6), "", "no text, no line");
    }

    #[test]
    fn a_closed_pipe_is_told_from_other_failures() {
        let broken = checked(Err(io::ErrorKind::BrokenPipe.into())).expect_err("the pipe is closed");
        assert!(broken.is::<ClosedPipe>(), "{broken}");
        let full = checked(Err(io::ErrorKind::StorageFull.into())).expect_err("the disk is full");
        assert!(!full.is::<ClosedPipe>(), "{full}");
    }

    #[test]
    fn counts_in_plain_words() {
        assert_eq!(counted(1, "process"), "1 process", "one");
        assert_eq!(counted(3, "process"), "3 processes", "three");
        assert_eq!(counted(0, "sample"), "0 samples", "none");
        assert_eq!(bytes(921_600.0), "921.6 kB", "an image");
    }
}
