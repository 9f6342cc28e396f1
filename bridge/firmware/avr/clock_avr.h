// Timer 1: counts 2 MHz for ever. Time stamps and servo pulses come from it; nothing ever sets it back.
#pragma once

#include <avr/io.h>
#include <stdint.h>

namespace carril {

void clock_begin();

// µs since the start; wraps after 71 minutes.
uint32_t clock_us();

// A moment within the last 8 s, in 24 bits: what interrupts can afford to note.
struct Stamp {
    uint16_t ticks;  // 0.5 µs
    uint8_t turns;   // of the timer
};

// For interrupts and where they are off. The low byte of the count of turns is in a register that nothing else uses.
inline Stamp clock_stamp() {
    const uint16_t ticks = TCNT1;
    uint8_t turns = GPIOR0;
    // The timer has turned and its interrupt has not run yet.
    if ((TIFR1 & _BV(TOV1)) != 0 && ticks < 0x8000) ++turns;
    return {ticks, turns};
}

// Between two stamps, µs.
uint32_t clock_us_between(Stamp from, Stamp to);

}  // namespace carril
