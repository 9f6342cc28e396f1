// Shortcuts of the page, and the list of them. Space stops the car wherever the focus is, unless someone types.
import type { Car } from "./car";
import { mayEstop, say } from "./control";
import { h, isTyping } from "./dom";
import { announce } from "./notices";

const KEYS: [string, string][] = [
  ["Space", "E-STOP (not while typing in a field)"],
  ["↑ ↓ ← →  W A S D", "drive by hand, while held and switched on"],
  ["Gamepad", "hold a shoulder button; left stick steers, right trigger drives, left trigger backs"],
  ["Enter", "presses what has the focus; on a node of the graph: its details"],
  ["Esc", "close details or dialog"],
  ["?", "this list"],
];

export function keyHelp(): HTMLDialogElement {
  const rows = KEYS.map(([key, what]) => h("tr", {}, h("th", { scope: "row" }, h("kbd", {}, key)), h("td", {}, what)));
  const dialog = h("dialog", { class: "dialog", "aria-label": "Keys" },
    h("button", { type: "button", class: "icon-button dialog-close", "aria-label": "Close", onclick: () => dialog.close() }, "×"),
    h("h2", {}, "Keys"), h("table", { class: "keys" }, h("tbody", {}, ...rows)));
  return dialog;
}

export function startKeys(car: Car, help: HTMLDialogElement): void {
  window.addEventListener("keydown", (event) => {
    if (isTyping(event.target) || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.code === "Space") {
      event.preventDefault(); // also where a focused button would take it for a click
      if (event.repeat) return;
      if (mayEstop(car)) void say(car, "estop");
      else announce("bad", "E-STOP did not get through: not connected, or not allowed here");
    } else if (event.key === "Enter" && event.target instanceof HTMLInputElement && event.target.type === "checkbox") {
      event.target.click(); // the space bar, which would do it elsewhere, is the e-stop here
    } else if (event.key === "?") {
      if (!help.open) help.showModal();
    }
  }, { capture: true });
  window.addEventListener("keyup", (event) => {
    if (event.code === "Space" && !isTyping(event.target)) event.preventDefault();
  }, { capture: true });
}
