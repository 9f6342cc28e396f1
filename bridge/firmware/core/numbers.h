// The few helpers that a chip without a standard library lacks. Never allocates, never uses floating point.
#pragma once

#include <stdint.h>

namespace carril {

template <class T>
constexpr T clamp(T value, T low, T high) {
    return value < low ? low : value > high ? high : value;
}

template <class T>
constexpr T magnitude(T value) {
    return value < 0 ? static_cast<T>(-value) : value;
}

// A moment of the past on a clock of 32 bits (µs), which wraps after 71 minutes. `keep` must run now and then; then the age
// grows to 18 minutes and stays there, however long ago the moment was.
class Moment {
public:
    void set(uint32_t at_us) {
        at_us_ = at_us;
        known_ = true;
    }

    void forget() { known_ = false; }

    bool known() const { return known_; }

    // A moment that is stamped a little later than `now` (an interrupt came in between) has the age 0.
    uint32_t age_us(uint32_t now_us) const {
        const int32_t age = static_cast<int32_t>(now_us - at_us_);
        return age < 0 ? 0 : static_cast<uint32_t>(age);
    }

    void keep(uint32_t now_us) {
        if (age_us(now_us) > OLDEST_US) at_us_ = now_us - OLDEST_US;
    }

private:
    static constexpr uint32_t OLDEST_US = 1UL << 30;
    uint32_t at_us_ = 0;
    bool known_ = false;
};

}  // namespace carril
