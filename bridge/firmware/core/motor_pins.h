// From a duty to the pins of a sign-magnitude motor driver: PWM and direction. PWM low shorts the motor: that is the brake.
// Never turns the direction while the PWM is on: it takes one pass without PWM and one for the turn.
#pragma once

#include "frame.h"
#include "numbers.h"

namespace carril {

struct MotorPins {
    // 0 to 255.
    uint8_t pwm = 0;
    bool forward = true;
};

class MotorGate {
public:
    // To be called in every pass with the duty that is wanted, in 1/1020, + forward.
    const MotorPins& pass(int16_t duty) {
        const bool forward = duty > 0;
        const uint8_t pwm = static_cast<uint8_t>((magnitude(duty) + 2) / 4);
        if (pwm == 0 || forward == pins_.forward) {
            pins_.pwm = pwm;
        } else if (pins_.pwm != 0) {
            pins_.pwm = 0;
        } else {
            pins_.forward = forward;
        }
        return pins_;
    }

private:
    MotorPins pins_;
};

}  // namespace carril
