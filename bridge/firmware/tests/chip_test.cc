// What the chip does: handshake, lease, faults, e-stop, watches. bridge/src/mcu_model.rs has the same tests for the model.
#include <doctest/doctest.h>

#include <random>

#include "bench.h"
#include "vectors.h"

using namespace carril;

TEST_CASE("nothing moves before the handshake") {
    Bench bench;
    bench.say(command(OUR_SESSION, 500, 200));
    bench.run_ms(50);
    CHECK(bench.braking());
    CHECK(bench.chip.pins().servo_us == 0);
    CHECK((bench.telemetry().flags & telemetry_flags::SESSION) == 0);
    bench.say(hello(OUR_SESSION));
    bench.say(command(9, 500, 200));
    bench.run_ms(50);
    CHECK_MESSAGE(bench.braking(), "nor for a command of another session");
    CHECK(bench.chip.faults() == 0);
}

TEST_CASE("says hello with version, capabilities and the checksum of its calibration") {
    Bench bench;
    bench.say(hello(OUR_SESSION));
    const HelloAck ack = bench.last(Kind::hello_ack).hello_ack;
    CHECK(ack.session == OUR_SESSION);
    CHECK(ack.capabilities == 0x3F);
    CHECK(ack.calibration_crc == bench.chip.calibration().crc());
}

TEST_CASE("drives after hello and command, and steers") {
    Bench bench = Bench::driving();
    CHECK(bench.chip.driving());
    CHECK(bench.chip.pins().motor_pwm > 0);
    CHECK(bench.chip.pins().motor_direction_level);
    CHECK(bench.chip.pins().servo_us == 1169);  // 1050 + 415 * 1000 / 3491
    CHECK(bench.telemetry().steering_tenth_mrad == 1000);
}

TEST_CASE("brakes at the end of the lease and latches it, wherever the clock stands") {
    // From before to after the wrap of the clock, and in the middle of the numbers.
    for (const uint32_t start_us : {0U, 0xFFFFFF00U, 0xFFFF0000U, 0xFFF00000U, 0x7FFFFF00U, 0x7FF80000U}) {
        for (const uint16_t lease_ms : {uint16_t{1}, uint16_t{20}, uint16_t{200}, uint16_t{2000}}) {
            CAPTURE(start_us);
            CAPTURE(lease_ms);
            Bench bench = Bench::driving(start_us);
            REQUIRE(bench.chip.driving());
            bench.say(command(OUR_SESSION, 500, lease_ms));
            bench.run_ms(lease_ms - 1U);
            CHECK(bench.chip.driving());
            bench.run_ms(1);
            CHECK(bench.braking());
            CHECK(bench.chip.faults() == fault::LEASE_EXPIRED);
            CHECK_MESSAGE(bench.chip.pins().servo_us != 0, "the servo holds its angle");
            bench.run_ms(20);
            CHECK((bench.telemetry().flags & telemetry_flags::SESSION) == 0);
        }
    }
}

TEST_CASE("after the lease only handshake, fault clear and command drive again, in this order") {
    Bench bench = Bench::driving();
    bench.run_ms(500);
    bench.say(command(OUR_SESSION, 500, 200));
    bench.run_ms(10);
    CHECK_MESSAGE(bench.braking(), "a command alone is not enough");
    bench.say(fault_clear(OUR_SESSION));
    bench.say(command(OUR_SESSION, 500, 200));
    bench.run_ms(10);
    CHECK_MESSAGE(bench.braking(), "nor a clear in the old session");
    bench.say(hello(2));
    bench.say(command(2, 500, 200));
    bench.run_ms(10);
    CHECK_MESSAGE(bench.braking(), "nor a handshake without a clear");
    CHECK_MESSAGE((bench.telemetry().flags & telemetry_flags::LAST_COMMAND) != 0, "but the command was heard");
    bench.say(fault_clear(2));
    bench.run_ms(10);
    CHECK_MESSAGE(bench.braking(), "and the command before the clear does not come back");
    bench.say(command(2, 500, 200));
    bench.run_ms(10);
    CHECK_MESSAGE(bench.chip.driving(), "all three together drive");
}

TEST_CASE("a command that comes after the end of the lease revives nothing") {
    Bench bench = Bench::driving();
    bench.now_us += 300000;
    bench.say(command(OUR_SESSION, 500, 200));
    bench.step();
    CHECK(bench.braking());
    CHECK(bench.chip.faults() == fault::LEASE_EXPIRED);
}

TEST_CASE("an e-stop by the host needs no session, stops at once and latches") {
    Bench bench = Bench::driving();
    bench.say(estop());
    bench.step();
    CHECK(bench.braking());
    CHECK(bench.chip.faults() == fault::ESTOP_BY_HOST);
    bench.say(hello(2));
    bench.say(command(2, 500, 200));
    bench.run_ms(10);
    CHECK(bench.braking());
}

TEST_CASE("a pressed button stops at once, and is cleared only once it is up") {
    Bench bench = Bench::driving();
    bench.readings.estop_level = false;
    bench.step();
    CHECK(bench.braking());
    CHECK(bench.chip.faults() == fault::ESTOP_PRESSED);
    bench.say(hello(2));
    bench.say(fault_clear(2));
    bench.run_ms(5);
    CHECK_MESSAGE(bench.chip.faults() == fault::ESTOP_PRESSED, "a pressed button cannot be cleared");
    bench.readings.estop_level = true;
    bench.run_ms(5);
    CHECK_MESSAGE(bench.chip.faults() == fault::ESTOP_PRESSED, "letting it go is not enough");
    bench.say(fault_clear(2));
    CHECK(bench.chip.faults() == 0);
}

TEST_CASE("another version is answered but not obeyed, except for its e-stop") {
    Bench bench = Bench::driving();
    bench.bytes(wire_of(hello(7), 2));
    bench.run_ms(5);
    const HelloAck ack = bench.last(Kind::hello_ack).hello_ack;
    CHECK(ack.session == 0);
    CHECK_MESSAGE(bench.chip.driving(), "the open session goes on");
    bench.bytes(wire_of(command(OUR_SESSION, 0, 200), 2));
    bench.run_ms(5);
    CHECK(bench.chip.pins().motor_pwm > 0);
    bench.bytes(wire_of(estop(), 2));
    bench.step();
    CHECK(bench.braking());
    CHECK(bench.chip.faults() == fault::ESTOP_BY_HOST);
}

TEST_CASE("the same hello changes nothing, another one ends the session, a release is no fault") {
    Bench bench = Bench::driving();
    bench.say(hello(OUR_SESSION));
    bench.run_ms(5);
    CHECK(bench.chip.driving());
    bench.say(release(OUR_SESSION));
    bench.run_ms(500);
    CHECK(bench.braking());
    CHECK(bench.chip.faults() == 0);
    Bench other = Bench::driving();
    other.say(hello(2));
    other.step();
    CHECK(other.braking());
    CHECK(other.chip.faults() == 0);
    other.say(release(OUR_SESSION));
    other.say(command(2, 500, 200));
    other.run_ms(10);
    CHECK_MESSAGE(other.chip.driving(), "a release of the old session is not meant for the new one");
}

TEST_CASE("a battery that is low for a second stops, and must rise by 0.2 V") {
    Bench bench = Bench::driving();
    bench.readings.battery_counts_16 = 6546;  // 6.0 V
    bench.drive_ms(950);
    CHECK(bench.chip.driving());
    bench.drive_ms(100);
    CHECK(bench.braking());
    CHECK(bench.chip.faults() == fault::BATTERY_LOW);
    CHECK(bench.telemetry().battery_mv == 5999);
    const auto clear = [&bench](uint16_t session) {
        bench.run_ms(10);
        bench.say(hello(session));
        bench.say(fault_clear(session));
        return bench.chip.faults();
    };
    bench.readings.battery_counts_16 = 7092;  // 6.5 V
    CHECK(clear(2) == fault::BATTERY_LOW);
    bench.readings.battery_counts_16 = 7213;  // 6.61 V
    CHECK(clear(3) == 0);
}

TEST_CASE("a battery that sags for a moment goes on") {
    Bench bench = Bench::driving();
    for (int i = 0; i < 5; ++i) {
        bench.readings.battery_counts_16 = 6546;
        bench.drive_ms(900);
        bench.readings.battery_counts_16 = 8730;
        bench.drive_ms(50);
    }
    CHECK(bench.chip.driving());
}

TEST_CASE("an encoder that is silent for a second while the motor pushes stops") {
    Bench bench = Bench::driving();
    bench.encoder_works = false;
    bench.drive_ms(950);
    CHECK(bench.chip.driving());
    bench.drive_ms(150);
    CHECK(bench.braking());
    CHECK(bench.chip.faults() == fault::ENCODER_SILENT);
}

TEST_CASE("a gentle push may stall, in raw duty too") {
    Bench bench = Bench::driving();
    bench.encoder_works = false;
    for (int i = 0; i < 60; ++i) {
        bench.say(raw_command(OUR_SESSION, 203, 200));
        bench.run_ms(50);
    }
    CHECK(bench.chip.driving());
    for (int i = 0; i < 30; ++i) {
        bench.say(raw_command(OUR_SESSION, 204, 200));
        bench.run_ms(50);
    }
    CHECK(bench.chip.faults() == fault::ENCODER_SILENT);
}

TEST_CASE("noise on the line is told and does not stop") {
    Bench bench = Bench::driving();
    for (int i = 0; i < 30; ++i) {
        for (int k = 0; k < 5; ++k) bench.bytes({1, 2, 3, 0});
        bench.say(command(OUR_SESSION, 500, 200));
        bench.run_ms(10);
    }
    CHECK(bench.chip.faults() == fault::LINK_NOISY);
    CHECK_MESSAGE(bench.chip.driving(), "good frames still get through");
    CHECK(bench.telemetry().damaged_frames == 150);
    bench.drive_ms(2500);
    CHECK_MESSAGE(bench.chip.faults() == 0, "a quiet second ends it");
}

TEST_CASE("a watchdog reset is a fault that a person must clear") {
    Bench bench = Bench::driving();
    bench.restart(true);
    bench.run_ms(20);
    CHECK(bench.telemetry().faults == fault::WATCHDOG_RESET);
    bench.say(hello(2));
    bench.say(command(2, 500, 200));
    bench.run_ms(10);
    CHECK(bench.braking());
    bench.say(fault_clear(2));
    bench.say(command(2, 500, 200));
    bench.run_ms(10);
    CHECK(bench.chip.driving());
}

TEST_CASE("telemetry comes every 10 ms from power-on") {
    Bench bench;
    bench.step();
    CHECK(bench.heard.size() == 1);
    bench.run_ms(1000);
    CHECK(bench.heard.size() == 101);
    CHECK(bench.telemetry().chip_time_us == 1000000);
}

TEST_CASE("what finds no room on the line is skipped, and counts as never sent") {
    Bench bench;
    bench.run_ms(100);
    const size_t before = bench.heard.size();
    const uint16_t seq = bench.heard.back().seq;
    bench.line_full = true;
    bench.run_ms(100);
    CHECK(bench.refused == 10);
    bench.line_full = false;
    bench.run_ms(10);
    CHECK(bench.heard.size() == before + 1);
    CHECK(bench.heard.back().seq == static_cast<uint16_t>(seq + 1));
}

TEST_CASE("the last command and its age are told, up to 65535 us") {
    Bench bench;
    bench.say(hello(OUR_SESSION));
    bench.say(command(OUR_SESSION, 0, 2000));
    bench.run_ms(10);
    CHECK(bench.telemetry().last_age_us == 10000);
    const uint16_t seq = bench.telemetry().last_seq;
    bench.run_ms(100);
    CHECK(bench.telemetry().last_age_us == UINT16_MAX);
    CHECK(bench.telemetry().last_seq == seq);
}

TEST_CASE("an old command does not become young when the clock wraps") {
    Bench bench = Bench::driving();
    bench.say(estop());
    bench.say(hello(2));
    bench.say(command(2, 500, 200));  // heard, but a fault stops: no lease runs, and the session stays
    for (int half_minutes = 0; half_minutes < 400; ++half_minutes) {
        bench.now_us += 30000000;
        bench.step();
        bench.run_ms(10);
        REQUIRE((bench.telemetry().flags & telemetry_flags::LAST_COMMAND) != 0);
        REQUIRE(bench.telemetry().last_age_us == UINT16_MAX);
    }
}

TEST_CASE("a wheel that has stood for hours does not turn again when the clock wraps") {
    Bench bench = Bench::driving();
    bench.say(release(OUR_SESSION));
    bench.run_ms(300);
    for (int half_minutes = 0; half_minutes < 400; ++half_minutes) {
        bench.now_us += 30000000;
        bench.step();
        bench.run_ms(10);
        REQUIRE((bench.telemetry().flags & telemetry_flags::TICK_PERIOD) == 0);
        REQUIRE(bench.telemetry().speed_mm_s == 0);
    }
}

TEST_CASE("time sync needs no session and tells the chip's time") {
    Bench bench;
    bench.run_ms(7);
    HostPacket sync = packet_of(Kind::time_sync);
    sync.token = 77;
    bench.say(sync);
    const TimeSyncAck ack = bench.last(Kind::time_sync_ack).time_sync_ack;
    CHECK(ack.token == 77);
    CHECK(ack.received_us == 7000);
    CHECK(ack.sent_us == 7000);
}

TEST_CASE("a lease ramp lets the duty fall in a straight line, and ends the session at once") {
    Bench bench;
    bench.say(hello(OUR_SESSION));
    bench.say(parameter_write(OUR_SESSION, Parameter::lease_ramp_ms, 400));
    bench.say(raw_command(OUR_SESSION, -1000, 100));
    bench.run_ms(99);
    const uint8_t full = bench.chip.pins().motor_pwm;
    CHECK(full == 250);
    bench.run_ms(2);
    CHECK(bench.chip.faults() == fault::LEASE_EXPIRED);
    CHECK(!bench.chip.driving());
    bench.run_ms(199);
    CHECK(bench.chip.pins().motor_pwm == doctest::Approx(125).epsilon(0.03));
    CHECK_MESSAGE(!bench.chip.pins().motor_direction_level, "still backwards");
    bench.run_ms(205);
    CHECK(bench.braking());
}

TEST_CASE("a fault or another session ends the lease ramp at once") {
    for (int how = 0; how < 3; ++how) {
        Bench bench;
        bench.say(hello(OUR_SESSION));
        bench.say(parameter_write(OUR_SESSION, Parameter::lease_ramp_ms, 1000));
        bench.say(command(OUR_SESSION, 1000, 100));
        bench.run_ms(150);
        REQUIRE(bench.chip.pins().motor_pwm > 0);
        if (how == 0) bench.say(estop());
        if (how == 1) bench.readings.estop_level = false;
        if (how == 2) bench.say(hello(2));
        bench.step();
        CHECK(bench.braking());
        bench.run_ms(20);
        CHECK_MESSAGE(bench.braking(), "and it does not go on");
    }
}

TEST_CASE("without its pins the chip has neither battery nor e-stop") {
    Bench bench;
    bench.say(hello(OUR_SESSION));
    bench.say(parameter_write(OUR_SESSION, Parameter::battery_pin, NO_PIN));
    bench.say(parameter_write(OUR_SESSION, Parameter::estop_pin, NO_PIN));
    bench.say(calibration_store(OUR_SESSION, bench.chip.calibration().crc()));
    bench.run_ms(200);
    bench.restart();
    bench.readings.battery_counts_16 = 0;
    bench.readings.estop_level = false;
    bench.drive();
    bench.drive_ms(2000);
    CHECK(bench.chip.driving());
    CHECK(bench.last(Kind::hello_ack).hello_ack.capabilities == 0x39);
    CHECK((bench.telemetry().flags & telemetry_flags::BATTERY) == 0);
}

TEST_CASE("the direction never turns while the motor's PWM is on") {
    Bench bench = Bench::driving();
    std::mt19937 random(3);
    bool level = bench.chip.pins().motor_direction_level;
    uint8_t pwm = bench.chip.pins().motor_pwm;
    unsigned turns = 0;
    for (int i = 0; i < 3000; ++i) {
        if (i % 20 == 0) bench.say(raw_command(OUR_SESSION, static_cast<int16_t>(random() % 2041 - 1020), 200));
        if (i % 977 == 0) bench.tick(3000);
        bench.run_ms(1);
        const Pins& pins = bench.chip.pins();
        if (pins.motor_direction_level != level) {
            ++turns;
            REQUIRE(pwm == 0);
            REQUIRE(pins.motor_pwm == 0);
        }
        level = pins.motor_direction_level;
        pwm = pins.motor_pwm;
    }
    CHECK(turns > 20);
}

TEST_CASE("random bytes never make it drive, and it still hears afterwards") {
    Bench bench;
    std::mt19937 random(4);
    bench.say(hello(OUR_SESSION));
    for (int i = 0; i < 2000; ++i) {
        Bytes noise(random() % 100);
        for (uint8_t& byte : noise) byte = static_cast<uint8_t>(random() % 4 == 0 ? 0 : random());
        bench.bytes(noise);
        bench.run_ms(1);
        REQUIRE(bench.chip.pins().motor_pwm == 0);
        REQUIRE(bench.chip.pins().servo_us == 0);
    }
    bench.say(command(OUR_SESSION, 500, 200));
    bench.run_ms(10);
    CHECK(bench.chip.driving());
}
