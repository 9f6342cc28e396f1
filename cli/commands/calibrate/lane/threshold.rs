//! The grey values of marking and floor in the rows that a `lane-detector` looks at, and the threshold that divides them, or that none
//! does.

use std::fmt::Write as _;
use std::path::Path;

use anyhow::{Result, anyhow, bail};
use carril_operators::lane_detector::survey::{Class, Findings, Greys, Survey, Verdict};
use carril_operators::lane_detector::{LaneDetectorConfig, Marking, Threshold};
use carril_runtime::Registry;
use carril_runtime::graph::calibration::Subject;
use serde_json::{Map, Value, json};

use super::{LaneArgs, look};
use crate::commands::calibrate::keep::{Found, keep};
use crate::commands::calibrate::target::Target;
use crate::common::graph_file::Shown;
use crate::common::output;

/// Grey values that share a line of the picture.
const BIN: usize = 16;
/// Longest bar of the picture, characters.
const BAR: usize = 24;
/// More that is neither marking nor floor is worth a word.
const MUCH_UNCLEAR: f64 = 0.15;

pub(super) fn run(args: &LaneArgs, target: &Target, registry: &Registry) -> Result<()> {
    let config: LaneDetectorConfig = target.config()?;
    let node = &target.node;
    let mut survey = Survey::new(&config).map_err(|why| anyhow!("node `{node}`: {why}"))?;
    let source = look(args, target, |image| survey.add(image))?;
    let findings = survey.findings();
    if !args.keep.json {
        output::text(told(target, &config, &source, &findings))?;
    }
    let Verdict::Divided { threshold, gap } = findings.verdict else {
        if args.keep.json {
            output::json(&figures_json(node, &source, &config, &findings, None))?;
            return Err(Shown.into());
        }
        bail!("{}", refused(node, &findings));
    };
    if !args.keep.json {
        output::line(format_args!(
            "\nproposal: {node}.threshold {threshold}, in the middle of {gap} free grey values"
        ))?;
    }
    let found = Found {
        subject: Subject::Lane,
        values: Map::from_iter([("threshold".to_owned(), threshold.into())]),
        figures: figures(&source, &findings, gap),
    };
    let saved = keep(&found, target, &args.keep, registry)?;
    if args.keep.json {
        output::json(&figures_json(node, &source, &config, &findings, saved.as_deref()))?;
    }
    Ok(())
}

/// The figures, as people want them.
fn told(target: &Target, config: &LaneDetectorConfig, source: &str, findings: &Findings) -> String {
    let frames = output::counted(findings.frames as u64, "frame");
    let mut text = format!(
        "{}: {frames} of `{source}`, rows around {} and {} of the height, marking {}\n\n",
        target.node,
        percent(config.row_far),
        percent(config.row_near),
        if config.marking == Marking::Dark { "dark" } else { "bright" },
    );
    let row = |name: &str, class: Option<Class>| {
        let Class { pixels, p0_5, p5, p50, p95, p99_5 } = class?;
        let mut cells = vec![name.to_owned(), pixels.to_string()];
        cells.extend([p0_5, p5, p50, p95, p99_5].map(|grey| grey.to_string()));
        Some(cells)
    };
    let rows = [row("floor", findings.floor), row("marking", findings.marking)];
    let rows: Vec<Vec<String>> = rows.into_iter().flatten().collect();
    text += &output::table(&["GREY VALUES", ">PIXELS", ">0.5 %", ">5 %", ">50 %", ">95 %", ">99.5 %"], &rows);
    text.push('\n');
    text += &picture(&findings.greys);
    if let Some(line) = present(config, findings) {
        let _ = write!(text, "\n{line}\n");
    }
    if findings.unclear_share > MUCH_UNCLEAR {
        let share = percent(findings.unclear_share);
        let _ = writeln!(text, "{share} of the pixels are neither: edges, glare, or lines along a row");
    }
    text
}

/// What the threshold in force makes of the frames.
fn present(config: &LaneDetectorConfig, findings: &Findings) -> Option<String> {
    let Threshold::Fixed(threshold) = config.threshold else { return None };
    let side = |above: f64| if config.marking == Marking::Dark { 1.0 - above } else { above };
    let [floor, marking] = &findings.greys;
    let (floor, marking) = (floor.share_above(threshold as u8)?, marking.share_above(threshold as u8)?);
    let (floor, marking) = (percent(side(floor)), percent(side(marking)));
    Some(format!("with threshold {threshold}, {marking} of the marking and {floor} of the floor count as marking"))
}

/// How often which grey values are: a line for 16 of them, bars against the most frequent of each class.
fn picture(greys: &[Greys; 2]) -> String {
    let bins = |greys: &Greys| -> Vec<u64> { greys.0.chunks(BIN).map(|bin| bin.iter().sum()).collect() };
    let [floor, marking] = greys.each_ref().map(bins);
    let used = |bin: &usize| floor[*bin] + marking[*bin] > 0;
    let (Some(first), Some(last)) = ((0..floor.len()).find(used), (0..floor.len()).rfind(used)) else {
        return String::new();
    };
    let bar = |bins: &[u64], bin: usize| {
        let most = bins.iter().max().copied().unwrap_or_default().max(1);
        // What is there at all is seen.
        "#".repeat(((bins[bin] * BAR as u64).div_ceil(most)) as usize)
    };
    let line = |bin: usize| {
        let (from, to) = (bin * BIN, bin * BIN + BIN - 1);
        let line = format!("{from:>3}-{to:<3}  {:<BAR$}  {}", bar(&floor, bin), bar(&marking, bin));
        line.trim_end().to_owned() + "\n"
    };
    let head = format!("{:<7}  {:<BAR$}  marking\n", "grey", "floor");
    head + &(first..=last).map(line).collect::<String>()
}

/// Why there is no proposal, and what helps.
fn refused(node: &str, findings: &Findings) -> String {
    match (findings.verdict, findings.floor, findings.marking) {
        (Verdict::Overlap { gap, frames_divided }, Some(floor), Some(marking)) => {
            let apart = if gap < 0 {
                format!("{} grey values in both", -gap)
            } else {
                format!("only {gap} grey values between them")
            };
            let reach = if floor.p50 < marking.p50 {
                format!("the floor reaches up to {} and the marking down to {}", floor.p99_5, marking.p5)
            } else {
                format!("the marking reaches up to {} and the floor down to {}", marking.p95, floor.p0_5)
            };
            let hint = if frames_divided > 0.9 {
                format!(
                    "the light changes from frame to frame; each by itself can be divided: `carril set {node} threshold=otsu`"
                )
            } else {
                format!(
                    "{} of the frames can be divided by themselves: light the track evenly, keep reflections out, set the \
                     exposure, or tell coloured tape by its colour (`marking: {{ hsv: .. }}`)",
                    if frames_divided == 0.0 { "none".to_owned() } else { format!("only {}", percent(frames_divided)) }
                )
            };
            format!("marking and floor overlap: {reach} ({apart}), so no threshold divides them\nhint: {hint}")
        }
        _ => format!(
            "no marking stands out from the floor in the rows that node `{node}` looks at\n\
             hint: put the car on the track, look at `carril echo {node}/debug --save debug.png`, and see that row_far and row_near \
             cross the markings and that `marking` is bright or dark as they are"
        ),
    }
}

/// What goes into the record.
fn figures(source: &str, findings: &Findings, gap: i32) -> Map<String, Value> {
    let mut figures = Map::new();
    figures.insert("from".into(), source.into());
    figures.insert("frames".into(), findings.frames.into());
    figures.insert("gap".into(), gap.into());
    for (name, class) in [("floor", findings.floor), ("marking", findings.marking)] {
        if let Some(class) = class {
            figures.insert(
                name.into(),
                json!({ "p5": class.p5, "p50": class.p50, "p95": class.p95, "p99_5": class.p99_5 }),
            );
        }
    }
    figures
}

fn figures_json(
    node: &str,
    source: &str,
    config: &LaneDetectorConfig,
    findings: &Findings,
    saved: Option<&Path>,
) -> Value {
    let proposal = match findings.verdict {
        Verdict::Divided { threshold, .. } => Some(threshold),
        Verdict::Overlap { .. } | Verdict::NoMarking => None,
    };
    json!({
        "node": node, "from": source, "rows": [config.row_far, config.row_near], "in_force": config.threshold,
        "findings": findings, "threshold": proposal, "saved": saved,
    })
}

/// `75 %`, `0.04 %`
fn percent(share: f64) -> String {
    let percent = share * 100.0;
    let rounded = if percent >= 10.0 { (percent * 10.0).round() / 10.0 } else { (percent * 100.0).round() / 100.0 };
    format!("{rounded} %")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_picture_has_a_line_for_every_sixteen_grey_values_between_both_ends() {
        let (mut floor, mut marking) = (Greys([0; 256]), Greys([0; 256]));
        (floor.0[60], floor.0[70], marking.0[100]) = (100, 1, 5);
        let expected = "\
grey     floor                     marking
 48-63   ########################
 64-79   #
 80-95
 96-111                            ########################
";
        assert_eq!(picture(&[floor, marking]), expected, "bars against the most frequent");
        assert_eq!(picture(&[Greys([0; 256]), Greys([0; 256])]), "", "nothing was seen");
    }

    #[test]
    fn shares_keep_what_is_small() {
        assert_eq!(
            [0.75, 1.0, 0.0, 0.000_4, 0.123_45].map(percent),
            ["75 %", "100 %", "0 %", "0.04 %", "12.3 %"],
            "shares"
        );
    }
}
