// The words of the control plane, and who may say them. Each answer is told to the user: silence after a press would be a lie.
import type { Car } from "./car";
import { setAttribute } from "./dom";
import { announce } from "./notices";
import { fields, list, text } from "./read";

export type Word = "start" | "stop" | "estop" | "reset";
const NAMES: Record<Word, string> = { start: "Start", stop: "Stop", estop: "E-STOP", reset: "Reset" };

export async function say(car: Car, word: Word): Promise<void> {
  try {
    const answer = fields(await car.connection.request({ type: "control", word }));
    const nodes = list(answer.nodes).map(text).filter(Boolean);
    const errors = list(answer.errors).map(text).filter(Boolean);
    const heard = nodes.length > 0 ? `heard by ${nodes.join(", ")}` : "no node answered";
    if (errors.length > 0) announce("bad", `${NAMES[word]}: ${errors.join("; ")} (${heard})`);
    else announce(nodes.length === 0 ? "bad" : word === "estop" ? "warn" : "good", `${NAMES[word]}: ${heard}`);
  } catch (error) {
    announce("bad", `${NAMES[word]} did not get through: ${(error as Error).message}`);
  }
}

export const mayEstop = (car: Car): boolean => car.connection.connected && (car.inControl || car.hello?.estop_open === true);

type Lockable = HTMLButtonElement | HTMLInputElement | HTMLSelectElement | HTMLTextAreaElement;
const guarded = new Set<{ element: WeakRef<Lockable>; title: string }>();

function lock(car: Car, element: Lockable, title: string): void {
  element.disabled = !car.inControl;
  setAttribute(element, "title", car.inControl ? title || null : car.connection.connected ? "read only: this needs control" : "not connected");
}

/** Usable only by who has control of a car that is there. */
export function needsControl<T extends Lockable>(car: Car, element: T): T {
  const title = element.title;
  guarded.add({ element: new WeakRef(element), title });
  lock(car, element, title);
  return element;
}

export function watchControl(car: Car): void {
  const update = () => {
    document.body.classList.toggle("read-only", car.hello?.access.level !== "control");
    for (const each of guarded) {
      const element = each.element.deref();
      if (element) lock(car, element, each.title);
      else guarded.delete(each);
    }
  };
  car.on("access", update);
  car.on("connection", update);
}
