// Road-wheel angle to servo pulse: two straight lines, from the right stop to the centre and on to the left stop, beyond which
// the servo does not go. Either stop may be the longer pulse.
#pragma once

#include "calibration.h"
#include "numbers.h"

namespace carril {

inline int16_t steering_within_limit(const Calibration& calibration, int16_t steering_tenth_mrad) {
    const int16_t limit = static_cast<int16_t>(calibration[Parameter::steering_limit_tenth_mrad]);
    return clamp<int16_t>(steering_tenth_mrad, static_cast<int16_t>(-limit), limit);
}

inline uint16_t servo_us(const Calibration& calibration, int16_t steering_tenth_mrad) {
    const int32_t limit = calibration[Parameter::steering_limit_tenth_mrad];
    const int32_t angle = steering_within_limit(calibration, steering_tenth_mrad);
    const int32_t center_us = calibration[Parameter::servo_center_us];
    const int32_t stop_us = calibration[angle < 0 ? Parameter::servo_right_us : Parameter::servo_left_us];
    // At most 2000 µs times 7854: far from the end of 32 bits. Half a µs is added so that the division rounds.
    const int32_t way = (stop_us - center_us) * magnitude(angle);
    return static_cast<uint16_t>(center_us + (way + (way < 0 ? -limit : limit) / 2) / limit);
}

}  // namespace carril
