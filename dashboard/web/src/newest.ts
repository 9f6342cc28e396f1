// Handles things one at a time and only the newest: what was overtaken while waiting is dropped, so nothing ever catches up.

export class Newest<T> {
  private next: { item: T } | null = null;
  private busy = false;

  constructor(private readonly handle: (item: T, overtaken: () => boolean) => Promise<void>, private readonly drop: (item: T) => void = () => {}) {}

  push(item: T): void {
    if (this.next) this.drop(this.next.item);
    this.next = { item };
    if (!this.busy) void this.run();
  }

  get idle(): boolean {
    return !this.busy;
  }

  clear(): void {
    this.next = null;
  }

  private async run(): Promise<void> {
    this.busy = true;
    while (this.next) {
      const { item } = this.next;
      this.next = null;
      try {
        await this.handle(item, () => this.next !== null);
      } catch (error) {
        console.error("one item failed, the next may not", error);
      }
    }
    this.busy = false;
  }
}

/** At most one `action` per `pause_ms`, and one at a time; of what comes meanwhile only the newest is done. */
export class Throttle<T> {
  private readonly queue: Newest<T>;

  constructor(pause_ms: number, action: (item: T) => Promise<void>, sleep: (ms: number) => Promise<void> = (ms) => new Promise((done) => setTimeout(done, ms))) {
    this.queue = new Newest(async (item) => {
      await Promise.all([action(item), sleep(pause_ms)]);
    });
  }

  push(item: T): void {
    this.queue.push(item);
  }

  /** Nothing waits, nothing runs, and the pause is over. */
  get idle(): boolean {
    return this.queue.idle;
  }

  clear(): void {
    this.queue.clear();
  }
}
