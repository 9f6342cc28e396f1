//! From YAML text to a value that remembers its positions, within limits: one document, 32 levels, plain scalars of the YAML 1.2
//! core schema, aliases that expand to at most 10 000 values. Reports everything it can in one run; never panics.

use std::collections::HashMap;
use std::ops::Range;

use saphyr_parser::{Event, Parser, ScalarStyle, Span, Tag};
use serde_json::{Number, Value};

use super::marked::{Entries, Entry, Marked, Place, Tree};
use super::source::Source;

/// Values may lie so deep.
pub const MAX_DEPTH: usize = 32;
/// Aliases may expand to so many values in all.
pub const MAX_ALIASED_VALUES: usize = 10_000;

/// Something wrong with the text.
pub(crate) struct YamlProblem {
    pub(crate) span: Range<usize>,
    pub(crate) rule: &'static str,
    pub(crate) message: String,
    pub(crate) hint: Option<&'static str>,
}

/// Reads the one document of `source`. `None`: there is nothing that could be read on.
pub(crate) fn read(source: &Source) -> (Option<Marked>, Vec<YamlProblem>) {
    let mut reader = Reader {
        source,
        stack: Vec::new(),
        root: None,
        documents: 0,
        anchors: HashMap::new(),
        aliased: 0,
        problems: Vec::new(),
    };
    reader.run();
    (reader.root, reader.problems)
}

struct Reader<'a> {
    source: &'a Source,
    stack: Vec<Frame>,
    root: Option<Marked>,
    documents: usize,
    anchors: HashMap<usize, Anchored>,
    aliased: usize,
    problems: Vec<YamlProblem>,
}

/// A list or map that is still open.
struct Frame {
    tree: Tree,
    start: usize,
    anchor: usize,
    key: Option<Key>,
    /// Where each key of a map was first given.
    keys: HashMap<String, Range<usize>>,
}

/// The key whose value comes next.
struct Key {
    text: String,
    span: Range<usize>,
    /// Reported already: its value is not kept.
    wrong: bool,
}

struct Anchored {
    value: Marked,
    values: usize,
    height: usize,
}

/// Reading cannot go on.
struct Fatal;

impl Reader<'_> {
    fn run(&mut self) {
        let text = self.source.text.as_str();
        for event in Parser::new_from_str(text) {
            let outcome = match event {
                Ok((event, span)) => self.event(event, span),
                Err(error) => {
                    let at = self.source.byte_of_char(error.marker().index());
                    self.report(at..at + 1, "yaml-syntax", format!("not valid YAML: {}", error.info()));
                    Err(Fatal)
                }
            };
            if outcome.is_err() {
                self.root = None;
                return;
            }
        }
    }

    fn event(&mut self, event: Event<'_>, span: Span) -> Result<(), Fatal> {
        let span = self.source.byte_of_char(span.start.index())..self.source.byte_of_char(span.end.index());
        match event {
            Event::DocumentStart(_) if self.documents > 0 => {
                self.report(span, "yaml-syntax", "a second document begins here; one is allowed".into());
                return Err(Fatal);
            }
            Event::DocumentStart(_) => self.documents += 1,
            Event::Scalar(text, style, anchor, tag) => {
                if let Some(tag) = tag {
                    self.refuse_tag(&span, &tag_text(&tag));
                }
                self.scalar(&text, style, anchor, span)?;
            }
            Event::SequenceStart(anchor, tag) => {
                self.open(Tree::List(Vec::new()), anchor, tag.as_deref().map(tag_text), span)?;
            }
            Event::MappingStart(anchor, tag) => {
                self.open(Tree::Map(Entries::default()), anchor, tag.as_deref().map(tag_text), span)?;
            }
            Event::SequenceEnd | Event::MappingEnd => self.close(span.end)?,
            Event::Alias(anchor) => self.alias(anchor, span)?,
            Event::Nothing | Event::StreamStart | Event::StreamEnd | Event::DocumentEnd => {}
        }
        Ok(())
    }

    fn report(&mut self, span: Range<usize>, rule: &'static str, message: String) {
        self.problems.push(YamlProblem { span, rule, message, hint: None });
    }

    fn report_with(&mut self, span: Range<usize>, rule: &'static str, message: String, hint: &'static str) {
        self.problems.push(YamlProblem { span, rule, message, hint: Some(hint) });
    }

    fn refuse_tag(&mut self, span: &Range<usize>, tag: &str) {
        let hint = "leave it out; quotes make a text of a number";
        self.report_with(span.clone(), "yaml-tag", format!("got the tag `{tag}`, tags are not allowed"), hint);
    }

    /// Whether the next value is a key.
    fn expects_key(&self) -> bool {
        self.stack.last().is_some_and(|frame| matches!(frame.tree, Tree::Map(_)) && frame.key.is_none())
    }

    fn scalar(&mut self, text: &str, style: ScalarStyle, anchor: usize, span: Range<usize>) -> Result<(), Fatal> {
        if self.expects_key() {
            self.key(text, span);
            return Ok(());
        }
        let tree = if style == ScalarStyle::Plain { self.plain(text, &span) } else { Tree::Scalar(text.into()) };
        self.put(Marked::new(tree, Place::File(span)), anchor, 1, 0)
    }

    fn plain(&mut self, text: &str, span: &Range<usize>) -> Tree {
        match resolve_plain(text) {
            Ok(value) => Tree::Scalar(value),
            Err(reason) => {
                self.report_with(
                    span.clone(),
                    "not-finite",
                    format!("got `{text}`, {reason}"),
                    "write a finite number",
                );
                Tree::Bad
            }
        }
    }

    fn key(&mut self, text: &str, span: Range<usize>) {
        let Some(frame) = self.stack.last_mut() else { return };
        let first = frame.keys.get(text).cloned();
        frame.key = Some(Key { text: text.to_owned(), span: span.clone(), wrong: first.is_some() });
        frame.keys.entry(text.to_owned()).or_insert_with(|| span.clone());
        if let Some(first) = first {
            let line = self.source.line_of(first.start);
            let hint = "remove one of them, or give it another name";
            self.report_with(span, "duplicate-key", format!("`{text}` is given twice, first in line {line}"), hint);
        }
    }

    fn open(&mut self, tree: Tree, anchor: usize, tag: Option<String>, span: Range<usize>) -> Result<(), Fatal> {
        if let Some(tag) = tag {
            self.refuse_tag(&span, &tag);
        }
        if self.expects_key() {
            self.report(span.clone(), "yaml-key", "a key must be a text, got a list or a map".into());
            return Err(Fatal);
        }
        if self.stack.len() >= MAX_DEPTH {
            self.report(span, "too-deep", format!("values lie deeper than {MAX_DEPTH} levels here"));
            return Err(Fatal);
        }
        self.stack.push(Frame { tree, start: span.start, anchor, key: None, keys: HashMap::new() });
        Ok(())
    }

    fn close(&mut self, end: usize) -> Result<(), Fatal> {
        let Some(frame) = self.stack.pop() else { return Ok(()) };
        let place = Place::File(frame.start..end);
        let value = Marked::new(frame.tree, place);
        let (values, height) = if frame.anchor > 0 { measure(&value) } else { (0, 0) };
        self.put(value, frame.anchor, values, height)
    }

    fn put(&mut self, mut value: Marked, anchor: usize, values: usize, height: usize) -> Result<(), Fatal> {
        if anchor > 0 {
            value.shared = true;
            self.anchors.insert(anchor, Anchored { value: value.clone(), values, height });
        }
        match self.stack.last_mut() {
            None => self.root = Some(value),
            Some(Frame { tree: Tree::List(items), .. }) => items.push(value),
            Some(Frame { tree: Tree::Map(entries), key, .. }) => {
                let Some(key) = key.take() else { return Err(Fatal) };
                if !key.wrong {
                    entries.push(Entry { key: key.text, key_place: Place::File(key.span), value });
                }
            }
            Some(_) => return Err(Fatal),
        }
        Ok(())
    }

    fn alias(&mut self, anchor: usize, span: Range<usize>) -> Result<(), Fatal> {
        if self.expects_key() {
            self.report(span, "yaml-key", "a key must be a text, got an alias".into());
            return Err(Fatal);
        }
        let Some(anchored) = self.anchors.get(&anchor) else {
            self.report(span, "yaml-alias", "the alias stands inside of the value that it repeats".into());
            return Err(Fatal);
        };
        self.aliased += anchored.values;
        if self.aliased > MAX_ALIASED_VALUES {
            let message = format!("the aliases up to here expand to more than {MAX_ALIASED_VALUES} values");
            self.report_with(span, "yaml-alias", message, "write the values out, or repeat less");
            return Err(Fatal);
        }
        if self.stack.len() + anchored.height > MAX_DEPTH {
            self.report(span, "too-deep", format!("what the alias repeats lies deeper than {MAX_DEPTH} levels here"));
            return Err(Fatal);
        }
        let (value, values, height) = (anchored.value.clone(), anchored.values, anchored.height);
        self.put(value, 0, values, height)
    }
}

fn tag_text(tag: &Tag) -> String {
    if tag.is_yaml_core_schema() { format!("!!{}", tag.suffix) } else { tag.to_string() }
}

/// Number of values, and levels below.
fn measure(value: &Marked) -> (usize, usize) {
    let mut total = (1, 0);
    let mut add = |child: &Marked| {
        let (values, height) = measure(child);
        total = (total.0 + values, total.1.max(height + 1));
    };
    match &value.tree {
        Tree::List(items) => items.iter().for_each(&mut add),
        Tree::Map(entries) => entries.iter().for_each(|entry| add(&entry.value)),
        Tree::Scalar(_) | Tree::Bad => {}
    }
    total
}

/// What a plain scalar means in the YAML 1.2 core schema. `Err`: a number that is not finite.
pub(super) fn resolve_plain(text: &str) -> Result<Value, &'static str> {
    match text {
        "" | "~" | "null" | "Null" | "NULL" => return Ok(Value::Null),
        "true" | "True" | "TRUE" => return Ok(Value::Bool(true)),
        "false" | "False" | "FALSE" => return Ok(Value::Bool(false)),
        ".nan" | ".NaN" | ".NAN" => return Err("which is no number"),
        _ => {}
    }
    let unsigned = text.strip_prefix(['+', '-']).unwrap_or(text);
    if matches!(unsigned, ".inf" | ".Inf" | ".INF") {
        return Err("which is infinite");
    }
    let radix = |prefix, radix| text.strip_prefix(prefix).and_then(|digits| u64::from_str_radix(digits, radix).ok());
    if let Some(number) = radix("0x", 16).or_else(|| radix("0o", 8)) {
        return Ok(number.into());
    }
    if !is_number(unsigned) {
        return Ok(text.into());
    }
    if let Ok(number) = text.parse::<i64>() {
        return Ok(number.into());
    }
    if let Ok(number) = text.parse::<u64>() {
        return Ok(number.into());
    }
    let number = text.parse::<f64>().ok().and_then(Number::from_f64);
    number.map(Value::Number).ok_or("which is too large for a number")
}

/// `[0-9]+(\.[0-9]*)?` or `\.[0-9]+`, with an exponent or without.
fn is_number(unsigned: &str) -> bool {
    let (mantissa, exponent) = unsigned.split_once(['e', 'E']).map_or((unsigned, None), |(m, e)| (m, Some(e)));
    let digits = |text: &str| text.bytes().all(|b| b.is_ascii_digit());
    let (whole, fraction) = mantissa.split_once('.').unwrap_or((mantissa, ""));
    let exponent_ok = exponent.is_none_or(|text| {
        let text = text.strip_prefix(['+', '-']).unwrap_or(text);
        !text.is_empty() && digits(text)
    });
    digits(whole) && digits(fraction) && !(whole.is_empty() && fraction.is_empty()) && exponent_ok
}

#[cfg(test)]
mod tests {
    use std::fmt::Write;

    use proptest::prelude::*;
    use serde_json::json;

    use super::*;

    fn parse(text: &str) -> (Option<Marked>, Vec<YamlProblem>) {
        read(&Source::new("test.yaml".into(), text.into()))
    }

    fn json_of(text: &str) -> Value {
        let (root, problems) = parse(text);
        let messages: Vec<_> = problems.iter().map(|problem| &problem.message).collect();
        assert!(problems.is_empty(), "{text:?} must be clean: {messages:?}");
        root.expect("a clean text has a value").to_json()
    }

    fn first_problem(text: &str) -> String {
        let (_, problems) = parse(text);
        problems.into_iter().next().map(|problem| problem.message).unwrap_or_default()
    }

    #[test]
    fn reads_scalars_of_the_core_schema() {
        let text = "{a: 1, b: -0.5, c: 1e3, d: yes, e: true, f: ~, g: '1', h: 0x1F, i: sim:mcu, j: .5, k: x-, l: 007}";
        let expected = json!({"a": 1, "b": -0.5, "c": 1000.0, "d": "yes", "e": true, "f": null, "g": "1", "h": 31,
            "i": "sim:mcu", "j": 0.5, "k": "x-", "l": 7});
        assert_eq!(json_of(text), expected, "YAML 1.2, not 1.1");
    }

    #[test]
    fn refuses_numbers_that_are_not_finite() {
        for text in ["a: .nan", "a: .inf", "a: -.Inf", "a: 1e999"] {
            assert!(first_problem(text).contains("which is"), "{text}: {}", first_problem(text));
        }
    }

    #[test]
    fn keeps_the_first_of_two_equal_keys() {
        let (root, problems) = parse("a: 1\nb: 2\na: 3\n");
        assert_eq!(problems.len(), 1, "one problem");
        assert_eq!(problems[0].message, "`a` is given twice, first in line 1", "the message");
        assert_eq!(root.map(|root| root.to_json()), Some(json!({"a": 1, "b": 2})), "reading goes on");
    }

    #[test]
    fn repeats_anchors_within_a_budget() {
        assert_eq!(json_of("a: &x {b: 1}\nc: *x\n"), json!({"a": {"b": 1}, "c": {"b": 1}}), "an ordinary alias");
        let mut bomb = String::from("a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]\n");
        for level in 1..20 {
            let alias = format!("*a{}", level - 1);
            let repeated = [alias.as_str(); 9].join(", ");
            writeln!(bomb, "a{level}: &a{level} [{repeated}]").expect("a string takes everything");
        }
        assert!(first_problem(&bomb).contains("more than 10000 values"), "{}", first_problem(&bomb));
    }

    #[test]
    fn refuses_what_is_too_deep_and_a_second_document() {
        let deep = "[".repeat(40) + &"]".repeat(40);
        assert!(first_problem(&deep).contains("deeper than 32"), "{}", first_problem(&deep));
        assert!(first_problem("a: 1\n---\nb: 2\n").contains("second document"), "two documents");
        assert!(first_problem("a: &x [*x]\n").contains("inside of the value"), "an alias of itself");
    }

    proptest! {
        #[test]
        fn never_panics(text in "[\\[\\]{}:,&*!|>'\"%@`\\-#? \n\tab01.~]{0,120}") {
            let _ = parse(&text);
        }

        #[test]
        fn never_panics_on_any_text(text in any::<String>()) {
            let _ = parse(&text);
        }
    }
}
