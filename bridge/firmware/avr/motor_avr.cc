// See motor_avr.h.
#include "motor_avr.h"

#include <avr/io.h>

#include "pin_avr.h"

namespace carril {

namespace {

// A timer's output unit: fast PWM, 16 MHz / 8 / 256 = 7.8 kHz.
struct Output {
    volatile uint8_t* control;
    volatile uint8_t* width;
    uint8_t connect;
};

Output output;
Pin direction;

// Pins 5 and 6 hang on timer 0, pins 3 and 11 on timer 2.
Output output_of(uint8_t pwm_pin) {
    switch (pwm_pin) {
        case 3: return {&TCCR2A, &OCR2B, _BV(COM2B1)};
        case 5: return {&TCCR0A, &OCR0B, _BV(COM0B1)};
        case 6: return {&TCCR0A, &OCR0A, _BV(COM0A1)};
        default: return {&TCCR2A, &OCR2A, _BV(COM2A1)};
    }
}

void disconnect() { *output.control &= static_cast<uint8_t>(~output.connect); }

}  // namespace

void motor_begin(const Calibration& calibration, const Pins& pins) {
    const uint8_t pwm_pin = static_cast<uint8_t>(calibration[Parameter::motor_pwm_pin]);
    output = output_of(pwm_pin);
    disconnect();
    Pin(pwm_pin).make_output(false);
    direction = Pin(static_cast<uint8_t>(calibration[Parameter::motor_direction_pin]));
    direction.make_output(pins.motor_direction_level);
    Pin(static_cast<uint8_t>(calibration[Parameter::motor_reset_pin])).make_output(true);
    TCCR0A = _BV(WGM01) | _BV(WGM00);
    TCCR0B = _BV(CS01);
    TCCR2A = _BV(WGM21) | _BV(WGM20);
    TCCR2B = _BV(CS21);
}

void motor_set(const Pins& pins) {
    // A width of 0 would still be a spike in each period, and a new width counts only from the next period on: to brake, the
    // pin is taken from the timer, which leaves it low at once.
    if (pins.motor_pwm == 0) disconnect();
    direction.set(pins.motor_direction_level);
    if (pins.motor_pwm == 0) return;
    *output.width = pins.motor_pwm;
    *output.control |= output.connect;
}

}  // namespace carril
