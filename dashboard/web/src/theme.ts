// Light or dark: as the system has it, until the user says otherwise. Canvases take their colours from the same CSS variables.
import { recall, remember } from "./memory";

export type Theme = "system" | "light" | "dark";
const ORDER: Theme[] = ["system", "light", "dark"];
const listeners: (() => void)[] = [];
const cache = new Map<string, string>();

export function theme(): Theme {
  const stored = recall("theme");
  return ORDER.find((each) => each === stored) ?? "system";
}

function apply(): void {
  const chosen = theme();
  if (chosen === "system") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = chosen;
  cache.clear();
  for (const listener of listeners) listener();
}

export function startTheme(): void {
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", apply);
  apply();
}

export function nextTheme(): Theme {
  const next = ORDER[(ORDER.indexOf(theme()) + 1) % ORDER.length] ?? "system";
  remember("theme", next);
  apply();
  return next;
}

export const onTheme = (listener: () => void): void => void listeners.push(listener);

/** The value of a colour variable of app.css: `color("ink")`. */
export function color(name: string): string {
  let value = cache.get(name);
  if (value === undefined) {
    value = getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
    cache.set(name, value);
  }
  return value;
}
