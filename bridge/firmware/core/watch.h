// What the chip keeps an eye on besides the lease: its battery, its encoder, the noise on its line. Readings and times in,
// verdicts out; never stops anything itself. Each must be asked at least every few minutes: times wrap.
#pragma once

#include "numbers.h"

namespace carril {

// Tells a low battery from one that a starting motor makes sag.
class BatteryWatch {
public:
    bool is_low(uint16_t battery_mv, int32_t low_mv, uint32_t now_us) {
        if (battery_mv >= low_mv) {
            low_since_.forget();
            return false;
        }
        if (!low_since_.known()) low_since_.set(now_us);
        low_since_.keep(now_us);
        return low_since_.age_us(now_us) >= LOW_AFTER_US;
    }

    // A battery that was low has recovered enough to drive again.
    static bool is_good(uint16_t battery_mv, int32_t low_mv) { return battery_mv >= low_mv + HYSTERESIS_MV; }

private:
    static constexpr uint32_t LOW_AFTER_US = 1000000;
    static constexpr int32_t HYSTERESIS_MV = 200;
    Moment low_since_;
};

// Notices a motor that is driven while the wheel does not turn.
class EncoderWatch {
public:
    // `last_tick` is unknown when there never was one. `duty` in 1/1020.
    bool is_silent(int16_t duty, const Moment& last_tick, uint32_t now_us) {
        if (magnitude(duty) < EXPECTED_DUTY) {
            driven_since_.forget();
            return false;
        }
        if (!driven_since_.known()) driven_since_.set(now_us);
        driven_since_.keep(now_us);
        return driven_since_.age_us(now_us) >= SILENT_AFTER_US &&
               (!last_tick.known() || last_tick.age_us(now_us) >= SILENT_AFTER_US);
    }

private:
    // A motor driven at least so hard must turn the wheel: a fifth of full duty.
    static constexpr int16_t EXPECTED_DUTY = 204;
    static constexpr uint32_t SILENT_AFTER_US = 1000000;
    Moment driven_since_;
};

// Counts damaged frames, second by second.
class NoiseWatch {
public:
    void count() {
        if (damaged_ <= NOISY_FRAMES) ++damaged_;
    }

    // Whether this second or the one before has had too many of them.
    bool is_noisy(uint32_t now_us) {
        const bool noisy = damaged_ > NOISY_FRAMES;
        const bool verdict = noisy || was_noisy_;
        if (now_us - began_us_ >= WINDOW_US) {
            began_us_ = now_us;
            damaged_ = 0;
            was_noisy_ = noisy;
        }
        return verdict;
    }

private:
    static constexpr uint8_t NOISY_FRAMES = 100;
    static constexpr uint32_t WINDOW_US = 1000000;
    uint32_t began_us_ = 0;
    uint8_t damaged_ = 0;
    bool was_noisy_ = false;
};

}  // namespace carril
