// One parameter of a node in the form: what the user moves is sent as it moves, and what the car refuses goes back to what is in force.
import type { Car } from "./car";
import { needsControl } from "./control";
import { h, setHidden, setText, withCode } from "./dom";
import { Throttle } from "./newest";
import { readReceipt } from "./protocol";
import { allowed, same, shown, sliderOf, tidy, typed, type Field } from "./schema";

/** While a slider is dragged, at most 5 a second. */
const PAUSE_MS = 200;

export class Parameter {
  readonly root: HTMLElement;
  private readonly reason = h("p", { class: "parameter-reason", role: "alert", hidden: true });
  private readonly state = h("span", { class: "parameter-state" });
  private readonly reset = h("button", { type: "button", class: "quiet parameter-reset", title: "Back to the default", onclick: () => this.wish(this.field.fallback) }, "↺");
  private readonly show: ((value: unknown) => void)[] = [];
  private readonly sender: Throttle<unknown>;
  private pending = 0;
  private touched = false;

  constructor(private readonly car: Car, private readonly node: string, private field: Field) {
    this.sender = new Throttle<unknown>(PAUSE_MS, (value) => this.send(value));
    const id = `p-${node}-${field.path}`.replace(/\W/g, "-");
    const unit = field.unit ? h("span", { class: "unit" }, field.unit) : null;
    const label = h("label", { for: id, class: "parameter-name" }, field.path, unit);
    const help = h("p", { class: "parameter-help", title: field.help }, ...withCode(field.help));
    this.root = h("div", { class: `parameter kind-${field.kind}`, "data-path": field.path },
      h("div", { class: "parameter-head" }, label, this.state, field.fallback === undefined ? null : needsControl(car, this.reset)), h("div", { class: "parameter-edit" }, ...this.controls(id)), this.reason, field.help ? help : null);
    this.showAll(field.value);
  }

  /** Hides what does not match. */
  filter(needle: string): void {
    setHidden(this.root, !this.field.path.toLowerCase().includes(needle.toLowerCase()));
  }

  /** A new configuration is in force. What the user holds just now is left alone. */
  inForce(field: Field): void {
    this.field = field;
    if (this.pending === 0 && !this.touched) this.showAll(field.value);
  }

  private showAll(value: unknown): void {
    for (const each of this.show) each(value);
    setHidden(this.reset, this.field.fallback === undefined || same(this.field.value, this.field.fallback));
  }

  private controls(id: string): HTMLElement[] {
    const { field } = this;
    if (field.kind === "boolean") return [this.checkbox(id)];
    if (field.kind === "choice") return [this.choice(id, field.nullable ? ["", ...field.words] : field.words)];
    if (field.kind === "json") return [this.line(id)];
    const slider = sliderOf(field);
    const controls = [slider ? this.slider(slider) : null, this.number(id), field.words.length > 0 ? this.words() : null];
    return controls.filter((each): each is HTMLElement => each !== null);
  }

  private checkbox(id: string): HTMLElement {
    const box = needsControl(this.car, h("input", { type: "checkbox", id, onchange: () => this.wish(box.checked) }));
    this.show.push((value) => { box.checked = value === true; });
    return box;
  }

  private choice(id: string, words: string[]): HTMLElement {
    const select = needsControl(this.car, h("select", { id, onchange: () => this.wish(select.value === "" ? null : select.value) }, ...words.map((word) => h("option", { value: word }, word || "none"))));
    this.show.push((value) => { select.value = typeof value === "string" ? value : ""; });
    return select;
  }

  private slider({ min, max, step }: { min: number; max: number; step: number }): HTMLElement {
    const slider = needsControl(this.car, h("input", { type: "range", min, max, step, "aria-label": this.field.path, oninput: () => this.drag(slider), onchange: () => this.release(slider) }));
    this.show.push((value) => { 
      if (typeof value === "number") slider.value = String(value);
      slider.classList.toggle("is-none", typeof value !== "number"); // a thumb at the left end would look like a value
    });
    return slider;
  }

  private drag(slider: HTMLInputElement): void {
    this.touched = true;
    const value = tidy(slider.valueAsNumber);
    for (const each of this.show) each(value);
    this.wish(value);
  }

  private release(slider: HTMLInputElement): void {
    this.touched = false;
    this.wish(tidy(slider.valueAsNumber));
  }

  private number(id: string): HTMLElement {
    const range = allowed(this.field);
    const box = needsControl(this.car, h("input", {
      type: "text", inputmode: "decimal", id, class: "parameter-number", title: range, placeholder: this.field.nullable ? "none" : null, autocomplete: "off",
      onfocus: () => { this.touched = true; }, onblur: () => { this.touched = false; this.showAll(this.field.value); },
      onchange: () => this.numberTyped(box.value),
    }));
    this.show.push((value) => { box.value = shown(value); });
    return box;
  }

  private numberTyped(input: string): void {
    const value = input.trim() === "" && this.field.nullable ? null : typed(input.replace(",", "."));
    if (value === "") return this.refuse("a value is needed");
    this.wish(value);
  }

  /** `otsu` beside a number: pressed, it is the value; released, the number is again. */
  private words(): HTMLElement {
    const buttons = this.field.words.map((word) => needsControl(this.car, h("button", { type: "button", class: "toggle", onclick: () => this.wish(same(this.field.value, word) ? (typeof this.field.fallback === "number" ? this.field.fallback : this.field.minimum) : word) }, word)));
    this.show.push((value) => buttons.forEach((button, at) => button.setAttribute("aria-pressed", String(this.field.words[at] === value))));
    return h("span", { class: "group" }, ...buttons);
  }

  private line(id: string): HTMLElement {
    const listId = `${id}-words`;
    const box = needsControl(this.car, h("input", { type: "text", id, class: "parameter-json", list: this.field.words.length > 0 ? listId : null, spellcheck: "false", autocomplete: "off", onchange: () => this.lineTyped(box.value) }));
    this.show.push((value) => { box.value = shown(value); });
    return h("span", { class: "parameter-line" }, box, this.field.words.length > 0 && h("datalist", { id: listId }, ...this.field.words.map((word) => h("option", { value: word }))));
  }

  private lineTyped(input: string): void {
    if (/^\s*[[{]/.test(input) && typeof typed(input) === "string") return this.refuse("this is no JSON");
    this.wish(input.trim() === "" ? null : typed(input));
  }

  private wish(value: unknown): void {
    if (same(value, this.field.value) && this.sender.idle) return this.settled(); // else what waits would be sent after it
    this.sender.push(value);
  }

  private async send(value: unknown): Promise<void> {
    this.pending += 1;
    setText(this.state, "…");
    try {
      const receipt = readReceipt(await this.car.connection.request({ type: "set", node: this.node, values: { [this.field.path]: value } }));
      if (receipt.outcome === "done") {
        this.field = { ...this.field, value };
        this.pending -= 1;
        this.settled("✓");
      } else {
        this.pending -= 1;
        this.refuse(receipt.reason ?? receipt.outcome);
      }
    } catch (error) {
      this.pending -= 1;
      this.refuse((error as Error).message);
    }
  }

  private settled(mark = ""): void {
    setText(this.state, mark);
    setHidden(this.reason, true);
    this.root.classList.remove("is-refused");
    if (!this.touched && this.pending === 0) this.showAll(this.field.value);
  }

  private refuse(reason: string): void {
    setText(this.state, "✕");
    this.reason.replaceChildren(...withCode(reason));
    setHidden(this.reason, false);
    this.root.classList.add("is-refused");
    this.showAll(this.field.value);
  }
}
