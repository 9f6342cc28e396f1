// Short words about what just happened, read aloud by screen readers. They go by themselves; the log keeps them.
import { h } from "./dom";

export type Tone = "good" | "warn" | "bad";
const SHOWN_MS = 6000;
const MOST = 3;

const region = h("div", { class: "notices", role: "status", "aria-live": "polite" });
let keep: (tone: Tone, text: string) => void = () => {};

export function startNotices(log: (tone: Tone, text: string) => void): HTMLElement {
  keep = log;
  return region;
}

const MARKS: Record<Tone, string> = { good: "✓", warn: "!", bad: "✕" };

export function announce(tone: Tone, text: string): void {
  keep(tone, text);
  const close = () => notice.remove();
  const notice = h("div", { class: `notice tone-${tone}` }, h("span", { class: "notice-mark", "aria-hidden": true }, MARKS[tone]), h("span", { class: "notice-text" }, text),
    h("button", { type: "button", class: "quiet", "aria-label": "Close", onclick: close }, "×"));
  region.append(notice);
  while (region.childElementCount > MOST) region.firstElementChild?.remove();
  window.setTimeout(close, tone === "bad" ? SHOWN_MS * 2 : SHOWN_MS);
}
