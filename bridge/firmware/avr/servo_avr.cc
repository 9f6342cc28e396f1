// See servo_avr.h.
#include "servo_avr.h"

#include <avr/interrupt.h>

#include "clock_avr.h"

namespace carril {

namespace {

constexpr uint16_t TICKS_PER_US = 2;
// From pulse to pulse. A little less than the usual 20 ms, so that a new angle is out within these 20 ms with its whole pulse,
// even when it comes just after a pulse has begun.
constexpr uint16_t PERIOD = 18000 * TICKS_PER_US;

Pin servo;
volatile uint16_t next_width;
// Within a pulse its width, between two pulses 0.
uint16_t width;

ISR(TIMER1_COMPA_vect) {
    if (width != 0) {
        servo.set_in_interrupt(false);
        OCR1A += PERIOD - width;
        width = 0;
        return;
    }
    width = next_width;
    if (width == 0) {
        OCR1A += PERIOD;
        return;
    }
    servo.set_in_interrupt(true);
    OCR1A += width;
}

}  // namespace

void servo_begin(Pin pin) {
    servo = pin;
    servo.make_output(false);
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { OCR1A = TCNT1 + PERIOD; }
    TIFR1 = _BV(OCF1A);
    TIMSK1 |= _BV(OCIE1A);
}

void servo_set(uint16_t pulse_us) {
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { next_width = pulse_us * TICKS_PER_US; }
}

}  // namespace carril
