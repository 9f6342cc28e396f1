// The frame around each panel: title, age of its data, collapse. Greys its content when the data is old or the connection is down.
import type { Car } from "./car";
import { h, setAttribute, setHidden, setText } from "./dom";
import { duration } from "./format";
import { recall, remember } from "./memory";

export interface PanelOptions {
  id: string;
  title: string;
  /** Older data is shown as stale; null: the panel has no age. */
  limit_ms: number | null;
  /** Age of the data; null: there is none yet. */
  age?: () => number | null;
  /** What to say when there is nothing to show at all; null: there is something. */
  absent?: () => string | null;
  changed?: () => void;
}

export class Panel {
  readonly root: HTMLElement;
  readonly body: HTMLElement;
  readonly tools: HTMLElement;
  private readonly ageLabel: HTMLElement;
  private readonly veil: HTMLElement;
  private readonly veilText: HTMLElement;
  private readonly toggle: HTMLButtonElement;
  private onScreen = true;
  collapsed: boolean;

  constructor(private readonly car: Car, private readonly options: PanelOptions) {
    this.collapsed = recall(`collapsed.${options.id}`) === "yes";
    this.toggle = h("button", { class: "panel-toggle", type: "button", onclick: () => this.setCollapsed(!this.collapsed) });
    this.ageLabel = h("span", { class: "panel-age" });
    this.tools = h("div", { class: "panel-tools" });
    this.veilText = h("span");
    this.veil = h("div", { class: "panel-veil", hidden: true }, this.veilText);
    this.body = h("div", { class: "panel-body", id: `${options.id}-body` });
    const title = h("h2", { class: "panel-title" }, options.title);
    const head = h("header", { class: "panel-head" }, this.toggle, title, this.ageLabel, this.tools);
    const frame = h("div", { class: "panel-frame" }, this.body, this.veil);
    this.root = h("section", { class: `panel panel-${options.id}`, id: options.id, "aria-label": options.title }, head, frame);
    this.setCollapsed(this.collapsed);
    new IntersectionObserver((entries) => {
      this.onScreen = entries.at(-1)?.isIntersecting ?? true;
      options.changed?.();
    }).observe(this.root);
  }

  /** Somebody can see its content. */
  get visible(): boolean {
    return !this.collapsed && this.onScreen && !document.hidden;
  }

  private setCollapsed(collapsed: boolean): void {
    this.collapsed = collapsed;
    remember(`collapsed.${this.options.id}`, collapsed ? "yes" : "no");
    this.root.classList.toggle("is-collapsed", collapsed);
    setAttribute(this.toggle, "aria-expanded", String(!collapsed));
    setAttribute(this.toggle, "aria-controls", `${this.options.id}-body`);
    setAttribute(this.toggle, "aria-label", `${collapsed ? "Show" : "Hide"} ${this.options.title}`);
    this.options.changed?.();
  }

  /** A few times a second: age is shown, and what is too old is greyed. */
  refresh(): void {
    if (this.options.limit_ms === null) return;
    const age = this.options.age?.() ?? null;
    const absent = this.options.absent?.() ?? null;
    const down = !this.car.connection.connected;
    const stale = absent === null && (down || age === null || age > this.options.limit_ms);
    this.root.classList.toggle("is-stale", stale);
    this.root.classList.toggle("is-absent", absent !== null);
    setText(this.ageLabel, absent !== null || age === null || stale ? "" : age < 1000 ? duration(age) : `${(age / 1000).toFixed(1)} s`);
    const words = absent ?? (!stale ? "" : age === null ? (down ? "not connected" : "no data yet") : `stale: ${(age / 1000).toFixed(1)} s`);
    setText(this.veilText, words);
    setHidden(this.veil, words === "");
  }
}
