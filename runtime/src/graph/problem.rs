//! What is wrong with a graph file: collected over a whole run, rendered for people, serialised for programs.

use std::fmt::{self, Write};
use std::ops::Range;

use annotate_snippets::{AnnotationKind, Group, Level, Origin, Renderer, Snippet};
use serde::Serialize;

/// So many problems are reported at most; the rest would only push the first off the screen.
pub const MAX_PROBLEMS: usize = 100;

/// Whether a problem keeps the graph from running.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// The graph cannot run.
    Error,
    /// It can, but probably not as meant.
    Warning,
    /// It can, and this is good to know.
    Note,
}

/// One thing wrong with a graph file.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Problem {
    /// The graph file, its calibration file, or the override: `dataflow.yaml`, `--set lane.threshold=300`.
    pub file: String,
    /// From 1; `None`: the file as a whole, or an override.
    pub line: Option<usize>,
    /// In characters, from 1.
    pub column: Option<usize>,
    /// Whether it keeps the graph from running.
    pub severity: Severity,
    /// Name of the rule that was broken: `unknown-node`.
    pub rule: &'static str,
    /// Which node, what we got, what is allowed.
    pub message: String,
    /// What to do.
    pub hint: Option<String>,
    #[serde(skip)]
    pub(crate) excerpt: Option<Excerpt>,
}

/// A line of the file, with the part of it that is meant.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Excerpt {
    pub(crate) line: usize,
    pub(crate) column: usize,
    pub(crate) text: String,
    pub(crate) span: Range<usize>,
}

impl Problem {
    /// An error of a file or an override as a whole.
    pub(crate) fn of_file(file: &str, rule: &'static str, message: String) -> Self {
        let severity = Severity::Error;
        Self { file: file.into(), line: None, column: None, severity, rule, message, hint: None, excerpt: None }
    }

    pub(crate) fn at(mut self, excerpt: Excerpt) -> Self {
        (self.line, self.column) = (Some(excerpt.line), Some(excerpt.column));
        self.excerpt = Some(excerpt);
        self
    }

    pub(crate) fn with_hint(mut self, hint: impl Into<String>) -> Self {
        self.hint = Some(hint.into());
        self
    }

    fn render(&self, renderer: &Renderer) -> String {
        let level = match self.severity {
            Severity::Error => Level::ERROR,
            Severity::Warning => Level::WARNING,
            Severity::Note => Level::NOTE,
        };
        let mut group = Group::with_title(level.primary_title(format!("{} [{}]", self.message, self.rule)));
        group = if let Some(excerpt) = &self.excerpt {
            let annotation = AnnotationKind::Primary.span(excerpt.span.clone());
            let snippet = Snippet::source(excerpt.text.as_str()).line_start(excerpt.line).path(self.file.as_str());
            group.element(snippet.annotation(annotation))
        } else {
            let mut origin = Origin::path(self.file.as_str());
            if let (Some(line), Some(column)) = (self.line, self.column) {
                origin = origin.line(line).char_column(column);
            }
            group.element(origin)
        };
        if let Some(hint) = &self.hint {
            group = group.element(Level::HELP.with_name("hint").message(hint.as_str()));
        }
        renderer.render(&[group])
    }
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.render(&plain()))
    }
}

/// Everything wrong with a graph file, in the order of the file. At most [`MAX_PROBLEMS`].
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
#[serde(transparent)]
pub struct Problems {
    list: Vec<Problem>,
    #[serde(skip)]
    left_out: usize,
}

impl Problems {
    pub(crate) fn push(&mut self, problem: Problem) {
        self.list.push(problem);
    }

    /// Counts one more, without keeping it.
    pub(crate) fn leave_out(&mut self) {
        self.left_out += 1;
    }

    /// By line: first those of the graph file, then those of its calibration file, then those that stand nowhere.
    pub(crate) fn sort(&mut self, graph_file: &str) {
        self.list.sort_by(|a, b| {
            let key =
                |problem: &Problem| (problem.line.is_none(), problem.file != graph_file, problem.line, problem.column);
            key(a).cmp(&key(b))
        });
    }

    /// All of them.
    pub fn iter(&self) -> std::slice::Iter<'_, Problem> {
        self.list.iter()
    }

    /// The first that is an error.
    pub fn first_error(&self) -> Option<&Problem> {
        self.list.iter().find(|problem| problem.severity == Severity::Error)
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.list.is_empty()
    }

    /// Those that keep the graph from running.
    pub fn errors(&self) -> usize {
        self.count(Severity::Error) + self.left_out
    }

    /// Those that do not.
    pub fn warnings(&self) -> usize {
        self.count(Severity::Warning)
    }

    /// What is only good to know.
    pub fn notes(&self) -> usize {
        self.count(Severity::Note)
    }

    fn count(&self, severity: Severity) -> usize {
        self.list.iter().filter(|problem| problem.severity == severity).count()
    }

    /// For people: position, line, caret and hint of each, and how many there are. `styled`: with the colours of a terminal.
    pub fn render(&self, styled: bool) -> String {
        let renderer = if styled { Renderer::styled().term_width(TERM_WIDTH) } else { plain() };
        let mut text = String::new();
        for problem in &self.list {
            text += &problem.render(&renderer);
            text += "\n\n";
        }
        if self.left_out > 0 {
            let _ = write!(text, "and at least {} more\n\n", self.left_out);
        }
        text + &self.summary() + "\n"
    }

    /// `2 errors, 1 warning`
    pub fn summary(&self) -> String {
        let counts = [(self.errors(), "error"), (self.warnings(), "warning"), (self.notes(), "note")];
        let told = counts.into_iter().filter(|(n, _)| *n > 0);
        let told: Vec<String> = told.map(|(n, what)| format!("{n} {what}{}", if n == 1 { "" } else { "s" })).collect();
        if told.is_empty() { "0 errors".to_owned() } else { told.join(", ") }
    }

    /// For programs: a list of `{file, line, column, severity, rule, message, hint}`.
    pub fn to_json(&self) -> serde_json::Value {
        serde_json::to_value(self).expect("texts and numbers always serialise")
    }
}

impl fmt::Display for Problems {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.render(false))
    }
}

impl<'a> IntoIterator for &'a Problems {
    type Item = &'a Problem;
    type IntoIter = std::slice::Iter<'a, Problem>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter()
    }
}

impl std::error::Error for Problems {}

const TERM_WIDTH: usize = 140;

fn plain() -> Renderer {
    Renderer::plain().term_width(TERM_WIDTH)
}
