// Steering, speed estimate and speed control, as numbers; bridge/src/speed_control.rs has the same tests in floating point.
#include <doctest/doctest.h>

#include <cmath>

#include "../core/steering.h"
#include "bench.h"

using namespace carril;

namespace {

uint8_t blank(uint16_t) { return 0xFF; }

Calibration defaults() {
    Calibration calibration;
    calibration.load(blank);
    return calibration;
}

void set(Calibration& calibration, Parameter parameter, int32_t value) {
    REQUIRE(parameter_allows(static_cast<uint8_t>(parameter), value));
    calibration.set(static_cast<uint8_t>(parameter), value);
}

// A motor with a first-order lag and an encoder; `strength` 1 is the nominal car.
struct Motor {
    double speed_m_s = 0;
    double distance_ticks = 0;
    double strength = 1;
    EncoderReading reading = {};

    void run(int16_t duty, uint32_t from_us, uint32_t step_us) {
        const bool brakes = duty == 0;
        const double goal = brakes ? 0 : duty / 1020.0 * 2.0 * strength;
        for (uint32_t us = 0; us < step_us; us += 50) {
            speed_m_s += (goal - speed_m_s) * 50e-6 / (brakes ? 0.05 : 0.2);
            const double before = distance_ticks;
            distance_ticks += std::abs(speed_m_s) * 50e-6 * 1e9 / 1570796;
            if (std::floor(distance_ticks) == std::floor(before)) continue;
            ++reading.ticks;
            const uint32_t at_us = from_us + us + 50;
            reading.period_us = at_us - reading.last_tick_us;
            reading.last_tick_us = at_us;
        }
    }
};

Motor drive(int32_t target_mm_s, double strength, uint32_t steps) {
    Motor motor;
    motor.strength = strength;
    Encoder encoder;
    SpeedControl control;
    const Calibration calibration = defaults();
    for (uint32_t step = 0; step < steps; ++step) {
        const uint32_t now_us = step * 5000;
        encoder.read(motor.reading, now_us);
        encoder.measure(now_us, calibration[Parameter::encoder_tick_nm]);
        const int16_t duty = control.hold(target_mm_s, encoder.speed_mm_s(), control.direction(), 5000, calibration);
        motor.run(duty, now_us, 5000);
    }
    return motor;
}

}  // namespace

TEST_CASE("the servo reaches its stops and not beyond") {
    Calibration calibration = defaults();
    CHECK(servo_us(calibration, INT16_MIN) == 635);
    CHECK(servo_us(calibration, -3491) == 635);
    CHECK(servo_us(calibration, 0) == 1050);
    CHECK(servo_us(calibration, 3491) == 1465);
    CHECK(servo_us(calibration, INT16_MAX) == 1465);
    CHECK(servo_us(calibration, 1) == 1050);
    CHECK(servo_us(calibration, 5) == 1051);
    CHECK(servo_us(calibration, -5) == 1049);
}

TEST_CASE("each side has a slope of its own, and right may be the longer pulse") {
    Calibration calibration = defaults();
    set(calibration, Parameter::servo_center_us, 1000);
    set(calibration, Parameter::steering_limit_tenth_mrad, 1000);
    CHECK(servo_us(calibration, -500) == 817);
    CHECK(servo_us(calibration, 500) == 1233);
    set(calibration, Parameter::servo_right_us, 2500);
    set(calibration, Parameter::servo_left_us, 500);
    CHECK(servo_us(calibration, -500) == 1750);
    CHECK(servo_us(calibration, 500) == 750);
    CHECK(servo_us(calibration, -1001) == 2500);
}

TEST_CASE("holds the speed of strong and weak cars both ways") {
    struct Case {
        int32_t target_mm_s;
        double strength;
    };
    for (const Case& one : {Case{500, 1.0}, Case{500, 0.75}, Case{500, 1.3}, Case{-400, 1.0}, Case{1500, 1.0}, Case{100, 1.0}}) {
        const Motor motor = drive(one.target_mm_s, one.strength, 800);
        const double error_mm_s = std::abs(motor.speed_m_s * 1000 - one.target_mm_s);
        CHECK_MESSAGE(error_mm_s < 20, "strength ", one.strength, ": got ", motor.speed_m_s, " m/s, wanted ",
                      one.target_mm_s, " mm/s within 20");
    }
}

TEST_CASE("brakes before it turns back, and stands below 5 mm/s") {
    const Calibration calibration = defaults();
    SpeedControl control;
    CHECK(control.hold(500, 500, control.direction(), 5000, calibration) > 0);
    CHECK(control.hold(-500, 500, control.direction(), 5000, calibration) == 0);
    CHECK(control.hold(-500, 50, control.direction(), 5000, calibration) < 0);
    CHECK(control.hold(-5, 0, control.direction(), 5000, calibration) < 0);
    CHECK(control.hold(-4, 0, control.direction(), 5000, calibration) == 0);
    CHECK(control.direction() == -1);
}

TEST_CASE("at its limit the integral does not wind up") {
    const Calibration calibration = defaults();
    SpeedControl control;
    // A car that is held for a minute pushes with all it may, and no more.
    int16_t duty = 0;
    for (int i = 0; i < 12000; ++i) duty = control.hold(500, 0, 1, 5000, calibration);
    CHECK(duty == 791);  // 255 + 127.5 + 408
    // Let go, it is at its speed again soon.
    int steps = 0;
    while (control.hold(500, 600, 1, 5000, calibration) > 255 && steps < 10000) ++steps;
    CHECK(steps < 1000);
}

TEST_CASE("while full duty is not enough, the integral learns nothing") {
    const Calibration calibration = defaults();
    SpeedControl control;
    for (int i = 0; i < 1000; ++i) REQUIRE(control.hold(2000, 1000, 1, 5000, calibration) == FULL_DUTY);
    CHECK(control.hold(1000, 1000, 1, 5000, calibration) == FULL_DUTY / 2);
    // Nor while less than none would be needed.
    for (int i = 0; i < 1000; ++i) REQUIRE(control.hold(100, 2000, 1, 5000, calibration) == 0);
    CHECK(control.hold(1000, 1000, 1, 5000, calibration) == FULL_DUTY / 2);
}

TEST_CASE("gains at the ends of their ranges neither overflow nor leave the duty's range") {
    for (const int32_t gains : {0, 1, 2, 3}) {
        for (const int32_t full : {100, 20000}) {
            for (const int32_t acceleration : {0, 1, 20000}) {
                Calibration calibration = defaults();
                set(calibration, Parameter::speed_p, (gains & 1) * 20000);
                set(calibration, Parameter::speed_i, (gains >> 1) * 20000);
                set(calibration, Parameter::speed_i_limit, 1020);
                set(calibration, Parameter::full_duty_speed_mm_s, full);
                set(calibration, Parameter::acceleration_mm_s2, acceleration);
                SpeedControl control;
                for (int i = 0; i < 300; ++i) {
                    const int32_t target = full / (1 + i / 100) * (i / 50 % 2 == 0 ? 1 : -1);
                    const int16_t wheel = static_cast<int16_t>(i % 7 * 5000);
                    const int16_t duty = control.hold(target, wheel, control.direction(), 50000, calibration);
                    CHECK(magnitude(duty) <= FULL_DUTY);
                }
            }
        }
    }
}

TEST_CASE("a limited acceleration leads to the speed in a straight line, both ways") {
    Calibration calibration = defaults();
    set(calibration, Parameter::acceleration_mm_s2, 1000);
    set(calibration, Parameter::speed_p, 0);
    set(calibration, Parameter::speed_i, 0);
    SpeedControl control;
    int16_t duty = 0;
    for (int i = 0; i < 100; ++i) duty = control.hold(1000, 0, 1, 5000, calibration);
    CHECK(duty == 255);  // half a second: 500 mm/s of 2000
    for (int i = 0; i < 200; ++i) duty = control.hold(1000, 0, 1, 5000, calibration);
    CHECK(duty == 510);
    for (int i = 0; i < 100; ++i) duty = control.hold(0, 0, 1, 5000, calibration);
    CHECK(duty == 255);
    // So small that a step is a fraction of a mm/s: it still gets there.
    set(calibration, Parameter::acceleration_mm_s2, 10);
    for (int i = 0; i < 2000; ++i) duty = control.hold(600, 0, 1, 5000, calibration);
    CHECK(duty == 306);
}

TEST_CASE("the dead duty is added to any duty but 0, and never beyond full") {
    Bench bench;
    bench.say(hello(OUR_SESSION));
    bench.say(parameter_write(OUR_SESSION, Parameter::motor_dead_duty, 100));
    const auto pwm_of = [&bench](int16_t duty) {
        bench.say(raw_command(OUR_SESSION, duty, 200));
        bench.run_ms(10);
        return bench.chip.pins().motor_pwm;
    };
    CHECK(pwm_of(0) == 0);
    CHECK(pwm_of(100) == 50);
    CHECK(pwm_of(-100) == 50);
    CHECK(!bench.chip.pins().motor_direction_level);
    CHECK(pwm_of(1020) == 255);
    CHECK(pwm_of(-1020) == 255);
}

TEST_CASE("the encoder: speed from the mean of its ticks, and a wheel whose ticks stay away stands") {
    Encoder encoder;
    EncoderReading reading = {};
    const int32_t tick_nm = 1570796;
    const auto at = [&](uint32_t ticks, uint32_t last_us, uint32_t period_us, uint32_t now_us) {
        reading.ticks = ticks;
        reading.last_tick_us = last_us;
        reading.period_us = period_us;
        encoder.read(reading, now_us);
        encoder.measure(now_us, tick_nm);
        return encoder.speed_mm_s();
    };
    CHECK(at(0, 0, 0, 1000) == 0);
    CHECK_MESSAGE(at(1, 4000, 4000, 5000) == 0, "one tick has no period");
    CHECK(!encoder.has_period(5000));
    CHECK(at(2, 7000, 3000, 10000) == 524);
    CHECK(encoder.period_us() == 3000);
    CHECK_MESSAGE(at(4, 14000, 2500, 15000) == 449, "two ticks in 7 ms, whatever the last of them");
    CHECK(at(4, 14000, 2500, 30000) == 449);
    CHECK_MESSAGE(at(4, 14000, 2500, 114000) == 20, "a pause of 100 ms is a slow wheel");
    CHECK_MESSAGE(at(4, 14000, 2500, 214000) == 0, "and 200 ms a standing one");
    CHECK(!encoder.has_period(214000));
}

TEST_CASE("the encoder at 20 000 edges a second, across the wrap of all its numbers") {
    Encoder encoder;
    EncoderReading reading = {};
    uint32_t now_us = 0xFFFF0000;
    for (int step = 0; step < 200; ++step) {
        now_us += 5000;
        reading.ticks += 100;
        reading.last_tick_us = now_us - 7;
        reading.period_us = 50;
        encoder.read(reading, now_us);
        encoder.measure(now_us, 1000000);
        if (step > 1) CHECK(encoder.speed_mm_s() == 20000);
    }
    CHECK(encoder.ticks() == 20000);
}

TEST_CASE("an edge that is stamped after the clock was read has age 0") {
    Encoder encoder;
    EncoderReading reading = {};
    reading.ticks = 5;
    reading.last_tick_us = 10003;
    reading.period_us = 1000;
    encoder.read(reading, 10000);
    encoder.measure(10000, 1570796);
    CHECK(encoder.speed_mm_s() == 1571);
    encoder.read(reading, 10001);
    CHECK(encoder.last_tick().age_us(10001) == 0);
}

TEST_CASE("with channel B the sign of the speed is the wheel's own") {
    Bench bench;
    bench.say(hello(OUR_SESSION));
    bench.say(parameter_write(OUR_SESSION, Parameter::encoder_b_pin, 12));
    bench.say(calibration_store(OUR_SESSION, bench.chip.calibration().crc()));
    bench.run_ms(200);
    bench.restart();
    for (int i = 0; i < 20; ++i) {
        bench.run_ms(3);
        bench.readings.encoder.backwards = true;
        bench.tick(3000);
    }
    bench.run_ms(20);
    CHECK(bench.telemetry().speed_mm_s == -524);
    CHECK_MESSAGE(bench.telemetry().ticks == 20, "ticks count up both ways");
    bench.say(hello(2));
    bench.say(command(2, 500, 200));
    bench.run_ms(5);
    CHECK_MESSAGE(bench.chip.pins().motor_pwm == 0, "a wheel that rolls backwards is braked before it is driven forward");
}
