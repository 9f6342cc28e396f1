// The motor driver's pins: PWM of 7.8 kHz, direction, reset. PWM low shorts the motor (sign-magnitude, as the Pololu MD07B):
// the brake. Never leaves the PWM's smallest spike on when the duty is 0.
#pragma once

#include <stdint.h>

#include "../core/calibration.h"
#include "../core/chip.h"

namespace carril {

// Brakes first, then enables the driver.
void motor_begin(const Calibration& calibration, const Pins& pins);
void motor_set(const Pins& pins);

}  // namespace carril
