//! Access from other machines: addresses, names and numbers that make sense.

use crate::graph::draft::{Draft, Report};
use crate::graph::remote;

pub(super) fn remote_makes_sense(draft: &Draft<'_>, report: &mut Report<'_>) {
    let Some(raw) = draft.remote else { return };
    for (path, message) in remote::read(raw).err().unwrap_or_default() {
        let place: Vec<&str> = ["remote"].into_iter().chain(path.iter().copied()).collect();
        report.error(draft.at(&place), "remote", format!("`remote.{}`: {message}", path.join(".")), None);
    }
}
