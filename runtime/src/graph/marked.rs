//! A YAML value that remembers where each of its parts stands. Pure data; made by the reader in `yaml.rs`.

use std::collections::HashMap;
use std::ops::Range;
use std::sync::Arc;

use serde_json::{Map, Value};

/// Where a part comes from.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Place {
    /// These bytes of the file.
    File(Range<usize>),
    /// These bytes of the calibration file.
    Calibration(Range<usize>),
    /// This override: `--set lane.threshold=300`.
    Set(Arc<str>),
}

impl Place {
    /// Whether nothing stands there: the value of `key:`.
    pub(crate) fn is_blank(&self) -> bool {
        matches!(self, Self::File(span) | Self::Calibration(span) if span.is_empty())
    }
}

/// A value with its place.
#[derive(Clone, Debug)]
pub(crate) struct Marked {
    pub(crate) tree: Tree,
    pub(crate) place: Place,
    /// It has an anchor or stands for one: what it says may be said in other places too.
    pub(crate) shared: bool,
}

/// What a value is.
#[derive(Clone, Debug)]
pub(crate) enum Tree {
    Scalar(Value),
    List(Vec<Marked>),
    Map(Entries),
    /// It was there, but has been reported as wrong. Left out of what is read on.
    Bad,
}

/// The keys of a map in the order of the file, each found at once: a file may have a hundred thousand.
#[derive(Clone, Debug, Default)]
pub(crate) struct Entries {
    list: Vec<Entry>,
    by_key: HashMap<String, usize>,
}

/// A key with its value.
#[derive(Clone, Debug)]
pub(crate) struct Entry {
    pub(crate) key: String,
    pub(crate) key_place: Place,
    pub(crate) value: Marked,
}

impl Entries {
    /// Puts a key at the end that is not there yet.
    pub(crate) fn push(&mut self, entry: Entry) {
        self.by_key.insert(entry.key.clone(), self.list.len());
        self.list.push(entry);
    }

    pub(crate) fn get(&self, key: &str) -> Option<&Entry> {
        self.by_key.get(key).map(|&index| &self.list[index])
    }

    pub(crate) fn get_mut(&mut self, key: &str) -> Option<&mut Entry> {
        self.by_key.get(key).map(|&index| &mut self.list[index])
    }

    pub(crate) fn iter(&self) -> std::slice::Iter<'_, Entry> {
        self.list.iter()
    }

    pub(crate) fn iter_mut(&mut self) -> std::slice::IterMut<'_, Entry> {
        self.list.iter_mut()
    }
}

/// What a path leads to.
pub(crate) struct Located<'a> {
    /// Place of the last key that exists; `None` at the root.
    pub(crate) key: Option<&'a Place>,
    /// The last value that exists.
    pub(crate) value: &'a Marked,
    /// How many parts of the path exist.
    pub(crate) depth: usize,
}

impl Marked {
    pub(crate) fn new(tree: Tree, place: Place) -> Self {
        Self { tree, place, shared: false }
    }

    pub(crate) fn null(place: Place) -> Self {
        Self::new(Tree::Scalar(Value::Null), place)
    }

    pub(crate) fn is_null(&self) -> bool {
        matches!(self.tree, Tree::Scalar(Value::Null))
    }

    /// Turns every place in it into another.
    pub(crate) fn replace_places(&mut self, replace: &dyn Fn(&Place) -> Place) {
        self.place = replace(&self.place);
        match &mut self.tree {
            Tree::List(items) => items.iter_mut().for_each(|item| item.replace_places(replace)),
            Tree::Map(entries) => {
                for entry in entries.iter_mut() {
                    entry.key_place = replace(&entry.key_place);
                    entry.value.replace_places(replace);
                }
            }
            Tree::Scalar(_) | Tree::Bad => {}
        }
    }

    /// As JSON, without what has been reported as wrong.
    pub(crate) fn to_json(&self) -> Value {
        match &self.tree {
            Tree::Scalar(value) => value.clone(),
            Tree::List(items) => Value::Array(items.iter().filter(|item| item.good()).map(Self::to_json).collect()),
            Tree::Map(entries) => Value::Object(json_map(entries)),
            Tree::Bad => Value::Null,
        }
    }

    fn good(&self) -> bool {
        !matches!(self.tree, Tree::Bad)
    }

    /// Whether it, or something in it, has been reported as wrong.
    pub(crate) fn has_bad_part(&self) -> bool {
        match &self.tree {
            Tree::Bad => true,
            Tree::Scalar(_) => false,
            Tree::List(items) => items.iter().any(Self::has_bad_part),
            Tree::Map(entries) => entries.iter().any(|entry| entry.value.has_bad_part()),
        }
    }

    /// The keys of a map, in the order of the file; also those whose values are wrong.
    pub(crate) fn keys(&self) -> impl Iterator<Item = &str> {
        let entries = if let Tree::Map(entries) = &self.tree { &entries.list[..] } else { &[] };
        entries.iter().map(|entry| entry.key.as_str())
    }

    /// Follows `path` as far as it goes.
    pub(crate) fn locate<S: AsRef<str>>(&self, path: &[S]) -> Located<'_> {
        let mut located = Located { key: None, value: self, depth: 0 };
        for part in path {
            match &located.value.tree {
                Tree::Map(entries) => {
                    let Some(entry) = entries.get(part.as_ref()) else { break };
                    (located.key, located.value) = (Some(&entry.key_place), &entry.value);
                }
                Tree::List(items) => {
                    let Some(item) = part.as_ref().parse().ok().and_then(|index: usize| items.get(index)) else {
                        break;
                    };
                    (located.key, located.value) = (None, item);
                }
                _ => break,
            }
            located.depth += 1;
        }
        located
    }

    /// Whether `path` leads to something, be it wrong.
    pub(crate) fn has<S: AsRef<str>>(&self, path: &[S]) -> bool {
        self.locate(path).depth == path.len()
    }

    /// The value at `path`.
    pub(crate) fn get_mut<S: AsRef<str>>(&mut self, path: &[S]) -> Option<&mut Self> {
        let mut value = self;
        for part in path {
            value = match &mut value.tree {
                Tree::Map(entries) => &mut entries.get_mut(part.as_ref())?.value,
                Tree::List(items) => items.get_mut(part.as_ref().parse::<usize>().ok()?)?,
                _ => return None,
            };
        }
        Some(value)
    }

    /// Turns a path into [`to_json`](Self::to_json)'s result into one into this value: list items that are left out count here.
    pub(crate) fn own_path(&self, json_path: &[String]) -> Vec<String> {
        let mut path = Vec::with_capacity(json_path.len());
        for part in json_path {
            let own = match (&self.locate(&path).value.tree, part.parse::<usize>()) {
                (Tree::List(items), Ok(index)) => items
                    .iter()
                    .enumerate()
                    .filter(|(_, item)| item.good())
                    .nth(index)
                    .map_or_else(|| part.clone(), |(own, _)| own.to_string()),
                _ => part.clone(),
            };
            path.push(own);
        }
        path
    }
}

fn json_map(entries: &Entries) -> Map<String, Value> {
    let good = entries.iter().filter(|entry| entry.value.good());
    good.map(|entry| (entry.key.clone(), entry.value.to_json())).collect()
}
