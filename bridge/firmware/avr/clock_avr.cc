// See clock_avr.h.
#include "clock_avr.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>

namespace carril {

namespace {

// Full turns of the timer, 32.768 ms each, without the low byte, which is in GPIOR0.
volatile uint16_t turns_high;

ISR(TIMER1_OVF_vect) {
    const uint8_t low = GPIOR0 + 1;
    GPIOR0 = low;
    if (low == 0) ++turns_high;
}

}  // namespace

void clock_begin() {
    TCCR1A = 0;
    TCCR1B = _BV(CS11);
    TIMSK1 = _BV(TOIE1);
}

uint32_t clock_us() {
    Stamp now;
    uint16_t high;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        now = clock_stamp();
        high = turns_high;
        // A turn that is pending, and carries.
        if (now.turns < GPIOR0) ++high;
    }
    // A turn is 2^16 ticks of half a µs: all but the topmost bit of 33 by moving whole bytes and one shift.
    const uint32_t half_us = static_cast<uint32_t>(high) << 24 | static_cast<uint32_t>(now.turns) << 16 | now.ticks;
    const uint32_t top = (high & 0x100) != 0 ? 1UL << 31 : 0;
    return half_us >> 1 | top;
}

uint32_t clock_us_between(Stamp from, Stamp to) {
    const uint16_t ticks = to.ticks - from.ticks;
    const uint8_t borrow = to.ticks < from.ticks ? 1 : 0;
    const uint8_t whole = static_cast<uint8_t>(to.turns - from.turns - borrow);
    return ((static_cast<uint32_t>(whole) << 16) | ticks) >> 1;
}

}  // namespace carril
