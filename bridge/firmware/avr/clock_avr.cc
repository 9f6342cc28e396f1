// See clock_avr.h.
#include "clock_avr.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>

namespace carril {

namespace {

// Full turns of the timer, 32.768 ms each.
volatile uint32_t turns;

ISR(TIMER1_OVF_vect) { ++turns; }

// The timer has turned and its interrupt has not run yet.
bool turn_is_pending(uint16_t ticks) { return (TIFR1 & _BV(TOV1)) != 0 && ticks < 0x8000; }

}  // namespace

void clock_begin() {
    TCCR1A = 0;
    TCCR1B = _BV(CS11);
    TIMSK1 = _BV(TOIE1);
}

uint32_t clock_us() {
    uint16_t ticks;
    uint32_t whole;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        ticks = TCNT1;
        whole = turns;
        if (turn_is_pending(ticks)) ++whole;
    }
    return (whole << 15) | (ticks >> 1);
}

Stamp clock_stamp() {
    const uint16_t ticks = TCNT1;
    uint8_t low = static_cast<uint8_t>(turns);
    if (turn_is_pending(ticks)) ++low;
    return {ticks, low};
}

uint32_t clock_us_between(Stamp from, Stamp to) {
    const uint16_t ticks = to.ticks - from.ticks;
    const uint8_t borrow = to.ticks < from.ticks ? 1 : 0;
    const uint8_t whole = static_cast<uint8_t>(to.turns - from.turns - borrow);
    return ((static_cast<uint32_t>(whole) << 16) | ticks) >> 1;
}

}  // namespace carril
