// See encoder_avr.h.
#include "encoder_avr.h"

#include <avr/interrupt.h>
#include <avr/io.h>

#include "clock_avr.h"
#include "pin_avr.h"

namespace carril {

namespace {

// Written by the interrupt. 16 bits of count are enough for 3 s at 20 000 edges a second.
struct Edges {
    uint16_t count;
    Stamp last;
    Stamp before;
    bool backwards;
};
volatile Edges edges;
Pin channel_a;
Pin channel_b;
EncoderReading reading;

ISR(INT0_vect) {
    const Stamp now = clock_stamp();
    edges.before.ticks = edges.last.ticks;
    edges.before.turns = edges.last.turns;
    edges.last.ticks = now.ticks;
    edges.last.turns = now.turns;
    ++edges.count;
    // Forward, channel A leads: after its edge the two differ.
    if (channel_b.exists()) edges.backwards = channel_a.level() == channel_b.level();
}
ISR(INT1_vect, ISR_ALIASOF(INT0_vect));

}  // namespace

void encoder_begin(const Calibration& calibration) {
    const uint8_t pin = static_cast<uint8_t>(calibration[Parameter::encoder_pin]);
    channel_a = Pin(pin);
    channel_b = Pin(static_cast<uint8_t>(calibration[Parameter::encoder_b_pin]));
    channel_a.make_input_with_pull_up();
    channel_b.make_input_with_pull_up();
    const bool second = pin == 3;
    // Every edge.
    EICRA = second ? _BV(ISC10) : _BV(ISC00);
    // The pull-up may just have made one.
    EIFR = _BV(INTF1) | _BV(INTF0);
    EIMSK = second ? _BV(INT1) : _BV(INT0);
}

EncoderReading encoder_read(uint32_t now_us) {
    uint16_t count;
    Stamp last, before, now;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        count = edges.count;
        last.ticks = edges.last.ticks;
        last.turns = edges.last.turns;
        before.ticks = edges.before.ticks;
        before.turns = edges.before.turns;
        reading.backwards = edges.backwards;
        now = clock_stamp();
    }
    const uint16_t fresh = count - static_cast<uint16_t>(reading.ticks);
    if (fresh != 0) {
        reading.ticks += fresh;
        // The clock has gone on since `now_us`, by less than it takes to see.
        reading.last_tick_us = now_us - clock_us_between(last, now);
        reading.period_us = clock_us_between(before, last);
    }
    return reading;
}

}  // namespace carril
