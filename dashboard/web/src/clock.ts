// Estimates the car's clock from ping and pong: the exchange with the shortest round trip in the window tells the offset best,
// since the longer ones waited in a queue on one way. Never asks for the time of day of either side.

const WINDOW_MS = 60_000;

interface Exchange { at_ms: number; round_trip_ms: number; offset_ms: number }

export class CarClock {
  private exchanges: Exchange[] = [];

  /** `sent_ms` and `received_ms` on the page's own monotonic clock, `car_ms` as the car said between them. */
  learn(sent_ms: number, received_ms: number, car_ms: number): void {
    const round_trip_ms = received_ms - sent_ms;
    if (!(round_trip_ms >= 0)) return;
    this.exchanges.push({ at_ms: received_ms, round_trip_ms, offset_ms: car_ms - (sent_ms + received_ms) / 2 });
    this.exchanges = this.exchanges.filter((each) => each.at_ms > received_ms - WINDOW_MS);
  }

  forget(): void {
    this.exchanges = [];
  }

  private best(): Exchange | null {
    return this.exchanges.reduce<Exchange | null>((best, each) => (!best || each.round_trip_ms < best.round_trip_ms ? each : best), null);
  }

  /** Of the newest exchange; null before the first. */
  roundTripMs(): number | null {
    return this.exchanges.at(-1)?.round_trip_ms ?? null;
  }

  /** The car's time at `page_ms`; null while it is not known. */
  carTimeMs(page_ms: number): number | null {
    const best = this.best();
    return best && page_ms + best.offset_ms;
  }
}
