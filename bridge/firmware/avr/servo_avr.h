// Servo pulses on any pin, from the compare interrupt of timer 1. Gives none before the first width is set, so that the servo
// is free until then.
#pragma once

#include <stdint.h>

#include "pin_avr.h"

namespace carril {

void servo_begin(Pin pin);
// From the next pulse on. 0: no pulses.
void servo_set(uint16_t pulse_us);

}  // namespace carril
