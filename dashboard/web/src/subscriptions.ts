// Asks the server for what somebody looks at, and for nothing else: images are made only while they are seen.
import type { Car } from "./car";
import type { Want } from "./protocol";

/** Several panels may want the same key: once, at the highest rate and size. */
export function unite(wants: Want[]): Want[] {
  const byKey = new Map<string, Want>();
  for (const want of wants) {
    const known = byKey.get(want.key);
    const united: Want = { ...known, ...want, max_hz: Math.max(known?.max_hz ?? 0, want.max_hz) };
    if (known?.width !== undefined && want.width !== undefined) united.width = Math.max(known.width, want.width);
    byKey.set(want.key, united);
  }
  return [...byKey.values()].sort((a, b) => (a.key < b.key ? -1 : 1));
}

export class Subscriptions {
  private sources: (() => Want[])[] = [];
  private asked = "";
  private planned = false;

  constructor(private readonly car: Car) {
    car.on("hello", () => {
      this.asked = ""; // a new connection knows nothing of what the last one was asked
      this.update();
    });
    car.on("graph", () => this.update());
    document.addEventListener("visibilitychange", () => {
      if (!document.hidden) car.forgetSamples();
      this.send(); // a hidden tab gets no turn later
    });
  }

  add(wants: () => Want[]): void {
    this.sources.push(wants);
  }

  /** Soon, once, whatever changes at the same time. */
  update(): void {
    if (this.planned) return;
    this.planned = true;
    queueMicrotask(() => {
      this.planned = false;
      this.send();
    });
  }

  private send(): void {
    const keys = document.hidden ? [] : unite(this.sources.flatMap((wants) => wants()));
    const text = JSON.stringify(keys);
    if (text !== this.asked && this.car.connection.send({ type: "subscribe", keys })) this.asked = text;
  }
}
