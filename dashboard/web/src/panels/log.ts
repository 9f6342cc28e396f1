// What the processes say. Bounded, filtered, and still when the user reads: it follows the end only while the end is in view.
import type { Car } from "../car";
import { h, setHidden, setText } from "../dom";
import { timeOfDay } from "../format";
import { recall, remember } from "../memory";
import { Panel } from "../panel";
import type { LogLine, Receipt } from "../protocol";

export const MOST_LINES = 2000;
const LEVELS: LogLine["level"][] = ["error", "warning", "info", "debug"];
const LETTERS: Record<LogLine["level"], string> = { error: "E", warning: "W", info: "I", debug: "D" };

export function wordsOf(receipt: Receipt): string {
  const change = receipt.from !== receipt.to ? ` ${receipt.from} → ${receipt.to}` : "";
  const cost = receipt.outcome === "done" && receipt.gap_ms ? `, gap ${receipt.gap_ms.toFixed(0)} ms, lost ${receipt.lost}` : "";
  return `${receipt.what} of ${receipt.node}: ${receipt.outcome}${change}${cost}${receipt.reason ? `: ${receipt.reason}` : ""}`;
}

export function logPanel(car: Car): { panel: Panel; add(line: LogLine): void } {
  const panel = new Panel(car, { id: "log", title: "Log", limit_ms: null });
  let lines: LogLine[] = [];
  let waiting: LogLine[] = [];
  let planned = false;
  let following = true;
  const known = new Set<string>();
  const processes = new Set<string>();
  const shownLevels = new Set<LogLine["level"]>(LEVELS.filter((level) => (recall(`log.${level}`) ?? (level === "debug" ? "no" : "yes")) === "yes"));

  const needle = h("input", { type: "search", placeholder: "filter text", "aria-label": "Filter text", oninput: () => rebuild() });
  const process = h("select", { "aria-label": "Process", onchange: () => rebuild() }, h("option", { value: "" }, "all"));
  const buttons = LEVELS.map((level) => h("button", { type: "button", class: `toggle level-${level}`, "aria-pressed": shownLevels.has(level) ? "true" : "false", "aria-label": level, title: level, onclick: (event: MouseEvent) => toggle(level, event.currentTarget as HTMLElement) }, LETTERS[level]));
  const list = h("div", { class: "log-list", role: "log", tabindex: 0, "aria-label": "Log lines", onscroll: () => scrolled() });
  const toEnd = h("button", { type: "button", class: "log-end", hidden: true, onclick: () => follow() }, "↓ newest");
  panel.tools.append(needle, process, h("div", { class: "group", role: "group", "aria-label": "Levels" }, ...buttons));
  panel.body.append(list, toEnd);

  function toggle(level: LogLine["level"], button: HTMLElement): void {
    if (!shownLevels.delete(level)) shownLevels.add(level);
    button.setAttribute("aria-pressed", String(shownLevels.has(level)));
    remember(`log.${level}`, shownLevels.has(level) ? "yes" : "no");
    rebuild();
  }

  function passes(line: LogLine): boolean {
    const text = needle.value.toLowerCase();
    return shownLevels.has(line.level) && (process.value === "" || process.value === line.process) && (text === "" || line.text.toLowerCase().includes(text) || line.process.toLowerCase().includes(text));
  }

  const row = (line: LogLine) => h("div", { class: `log-line level-${line.level}` },
    h("span", { class: "log-time" }, timeOfDay(line.time_ms)), h("span", { class: "log-level", title: line.level }, LETTERS[line.level]), h("span", { class: "log-process" }, line.process), h("span", { class: "log-text" }, line.text));

  function rebuild(): void {
    list.replaceChildren(...lines.filter(passes).map(row));
    if (following) follow();
  }

  function flush(): void {
    planned = false;
    const fresh = waiting;
    waiting = [];
    lines.push(...fresh);
    const shown = fresh.filter(passes);
    list.append(...shown.map(row));
    if (lines.length > MOST_LINES) {
      lines = lines.slice(-MOST_LINES);
      known.clear();
      for (const line of lines) known.add(identity(line));
    }
    while (list.childElementCount > MOST_LINES) list.firstElementChild?.remove();
    if (following && shown.length > 0) follow();
  }

  function scrolled(): void {
    following = list.scrollTop + list.clientHeight >= list.scrollHeight - 8;
    setHidden(toEnd, following);
  }

  function follow(): void {
    following = true;
    list.scrollTop = list.scrollHeight;
    setHidden(toEnd, true);
  }

  const identity = (line: LogLine) => `${line.time_ms} ${line.process} ${line.text}`;

  function add(line: LogLine): void {
    waiting.push(line);
    if (waiting.length > MOST_LINES) waiting.shift();
    if (!processes.has(line.process)) {
      processes.add(line.process);
      process.append(h("option", { value: line.process }, line.process));
    }
    if (planned) return;
    planned = true;
    window.setTimeout(flush, 100); // a burst is one change of the page
  }

  const own = (level: LogLine["level"], text: string) => add({ time_ms: car.now() ?? Date.now(), level, process: "page", text });

  car.on("log", (line) => {
    const name = identity(line); // old lines come again after each reconnect
    if (known.has(name)) return;
    known.add(name);
    add(line);
  });
  car.on("receipt", (receipt) => add({ time_ms: car.now() ?? Date.now(), level: receipt.outcome === "done" ? "info" : "warning", process: "receipt", text: wordsOf(receipt) }));
  car.on("note", ({ level, text }) => own(level, text));
  setText(toEnd, "↓ newest");
  return { panel, add };
}
