// The parameters and their way to the EEPROM and back.
#include <doctest/doctest.h>

#include "bench.h"
#include "vectors.h"

using namespace carril;

namespace {

ParameterAnswer asked(Bench& bench, const HostPacket& packet) {
    bench.heard.clear();
    bench.say(packet);
    return bench.last(Kind::parameter).parameter;
}

CalibrationAnswer query(Bench& bench) {
    bench.say(packet_of(Kind::calibration_query));
    return bench.last(Kind::calibration).calibration;
}

// Stores and waits for the answer.
CalibrationAnswer stored(Bench& bench, uint16_t session, uint16_t crc) {
    bench.heard.clear();
    bench.say(calibration_store(session, crc));
    for (int i = 0; i < 1000 && !bench.has_heard(Kind::calibration); ++i) bench.run_ms(1);
    return bench.last(Kind::calibration).calibration;
}

}  // namespace

TEST_CASE("the table is the one of bridge/vectors") {
    static const char* const names[PARAMETERS] = {
        "servo_pin", "servo_right_us", "servo_center_us", "servo_left_us", "steering_limit_tenth_mrad", "motor_pwm_pin",
        "motor_direction_pin", "motor_reset_pin", "motor_forward_level", "full_duty_speed_mm_s", "encoder_pin",
        "encoder_b_pin", "encoder_tick_nm", "speed_p", "speed_i", "speed_i_limit", "lease_ramp_ms",
        "acceleration_mm_s2", "motor_dead_duty", "battery_pin", "battery_full_scale_mv", "battery_low_mv", "estop_pin",
        "estop_pressed_level"};
    const auto lines = vector_lines("parameters.txt");
    REQUIRE(lines.size() == PARAMETERS);
    for (uint8_t index = 0; index < PARAMETERS; ++index) {
        const auto& line = lines[index];
        CAPTURE(line[1]);
        REQUIRE(line.size() == 6);
        CHECK(std::stoi(line[0]) == index);
        CHECK(line[1] == names[index]);
        const int32_t minimum = std::stoi(line[3]);
        const int32_t maximum = std::stoi(line[4]);
        CHECK(parameter_allows(index, minimum));
        CHECK(parameter_allows(index, maximum));
        CHECK(!parameter_allows(index, minimum - 1));
        CHECK(!parameter_allows(index, maximum + 1));
        CHECK(!parameter_allows(index, INT32_MIN));
        CHECK(!parameter_allows(index, INT32_MAX));
        CHECK(parameter_default(index) == std::stoi(line[5]));
        CHECK(parameter_allows(index, parameter_default(index)));
    }
}

TEST_CASE("a pin that does not exist is out of range") {
    const auto allows = [](Parameter parameter, int32_t value) {
        return parameter_allows(static_cast<uint8_t>(parameter), value);
    };
    for (const int32_t pin : {3, 5, 6, 11}) CHECK(allows(Parameter::motor_pwm_pin, pin));
    for (const int32_t pin : {4, 7, 8, 9, 10}) CHECK(!allows(Parameter::motor_pwm_pin, pin));
    for (const Parameter parameter : {Parameter::motor_reset_pin, Parameter::encoder_b_pin, Parameter::estop_pin}) {
        CHECK(allows(parameter, 19));
        CHECK(!allows(parameter, 20));
        CHECK(!allows(parameter, 254));
        CHECK(allows(parameter, 255));
    }
    CHECK(allows(Parameter::battery_pin, 21));
    CHECK(!allows(Parameter::battery_pin, 22));
    CHECK(allows(Parameter::battery_pin, 255));
}

TEST_CASE("reading needs no session, also of what does not exist") {
    Bench bench;
    const ParameterAnswer left = asked(bench, parameter_read(3));
    CHECK(left.status == Status::done);
    CHECK(left.value == 1465);
    const ParameterAnswer none = asked(bench, parameter_read(PARAMETERS));
    CHECK(none.status == Status::no_such_parameter);
    CHECK(none.value == 0);
    const CalibrationAnswer whole = query(bench);
    CHECK(whole.count == PARAMETERS);
    CHECK(whole.crc_in_force == bench.chip.calibration().crc());
    CHECK(whole.crc_stored == 0xFFFF);
}

TEST_CASE("writing counts only in the open session, within the range, and while the car does not drive") {
    Bench bench;
    const auto write = [&bench](uint16_t session, int32_t value) {
        return asked(bench, parameter_write(session, Parameter::servo_left_us, value));
    };
    CHECK(write(OUR_SESSION, 1500).status == Status::not_the_open_session);
    bench.say(hello(OUR_SESSION));
    CHECK(write(OUR_SESSION + 1, 1500).status == Status::not_the_open_session);
    CHECK(write(OUR_SESSION, 2501).status == Status::out_of_range);
    const ParameterAnswer refused = write(OUR_SESSION, 499);
    CHECK(refused.status == Status::out_of_range);
    CHECK_MESSAGE(refused.value == 1465, "the value in force is told");
    const uint16_t crc_before = bench.chip.calibration().crc();
    const ParameterAnswer taken = write(OUR_SESSION, 1500);
    CHECK(taken.status == Status::done);
    CHECK(taken.value == 1500);
    CHECK(bench.chip.calibration().crc() != crc_before);
    CHECK(query(bench).crc_in_force == bench.chip.calibration().crc());
    bench.say(command(OUR_SESSION, 0, 200));
    CHECK_MESSAGE(write(OUR_SESSION, 1400).status == Status::driving, "a lease runs, whatever the speed");
    HostPacket none = parameter_write(OUR_SESSION, Parameter::servo_pin, 9);
    none.index = PARAMETERS;
    CHECK(asked(bench, none).status == Status::no_such_parameter);
    bench.heard.clear();
    bench.say(packet_of(Kind::calibration_defaults, OUR_SESSION));
    CHECK(bench.last(Kind::calibration).calibration.status == Status::driving);
    CHECK(stored(bench, OUR_SESSION, bench.chip.calibration().crc()).status == Status::driving);
    CHECK(bench.eeprom_writes == 0);
}

TEST_CASE("a value counts from when it is written") {
    Bench bench = Bench::driving();
    const uint16_t before_us = bench.chip.pins().servo_us;
    bench.say(hello(2));
    bench.say(parameter_write(2, Parameter::servo_left_us, 2465));
    CHECK_MESSAGE(bench.chip.pins().servo_us > before_us + 200, "the angle that is held is another pulse now");
    bench.say(packet_of(Kind::calibration_defaults, 2));
    CHECK(bench.last(Kind::calibration).calibration.status == Status::done);
    CHECK(bench.chip.pins().servo_us == before_us);
    bench.say(parameter_write(2, Parameter::estop_pressed_level, 1));
    bench.step();
    CHECK(bench.chip.faults() == fault::ESTOP_PRESSED);
}

TEST_CASE("what is stored outlasts a restart, and only what is meant is stored") {
    Bench bench;
    bench.say(hello(OUR_SESSION));
    bench.say(parameter_write(OUR_SESSION, Parameter::encoder_tick_nm, 1234567));
    const uint16_t crc = bench.chip.calibration().crc();
    CHECK(stored(bench, OUR_SESSION + 1, crc).status == Status::not_the_open_session);
    const CalibrationAnswer differs = stored(bench, OUR_SESSION, crc ^ 1);
    CHECK(differs.status == Status::crc_differs);
    CHECK(differs.crc_stored == 0xFFFF);
    CHECK(bench.eeprom_writes == 0);
    const CalibrationAnswer done = stored(bench, OUR_SESSION, crc);
    CHECK(done.status == Status::done);
    CHECK(done.crc_stored == crc);
    bench.restart();
    CHECK(bench.chip.calibration()[Parameter::encoder_tick_nm] == 1234567);
    CHECK(bench.chip.calibration().crc() == crc);
    CHECK(bench.chip.calibration().stored_crc() == crc);
    CHECK(bench.chip.faults() == 0);
    // Without a store a value is gone.
    bench.say(hello(2));
    bench.say(parameter_write(2, Parameter::encoder_tick_nm, 7654321));
    bench.restart();
    CHECK(bench.chip.calibration()[Parameter::encoder_tick_nm] == 1234567);
}

TEST_CASE("the bytes in the EEPROM are those of the protocol") {
    Bench bench;
    bench.say(hello(OUR_SESSION));
    REQUIRE(stored(bench, OUR_SESSION, bench.chip.calibration().crc()).status == Status::done);
    const Bytes& eeprom = Bench::eeprom();
    CHECK(eeprom[0] == 1);
    CHECK(eeprom[1] == 24);
    CHECK(eeprom[2] == 9);
    CHECK(Bytes(eeprom.begin() + 50, eeprom.begin() + 54) == Bytes{0xEC, 0xF7, 0x17, 0x00});  // 1 570 796
    CHECK((eeprom[98] | eeprom[99] << 8) == crc16(eeprom.data(), 98));
    CHECK(eeprom[100] == 0xFF);
}

TEST_CASE("a store takes a byte at a time, writes only what differs, and does not stop the car") {
    Bench bench;
    bench.say(hello(OUR_SESSION));
    REQUIRE(stored(bench, OUR_SESSION, bench.chip.calibration().crc()).status == Status::done);
    bench.say(parameter_write(OUR_SESSION, Parameter::speed_p, 300));
    bench.eeprom_writes = 0;
    bench.heard.clear();
    bench.say(calibration_store(OUR_SESSION, bench.chip.calibration().crc()));
    bench.eeprom_ready = false;
    bench.drive_ms(200);
    CHECK_MESSAGE(bench.eeprom_writes == 0, "the EEPROM is busy");
    CHECK(bench.chip.driving());
    CHECK_MESSAGE(!bench.has_heard(Kind::calibration), "no answer before it is done");
    bench.eeprom_ready = true;
    bench.drive_ms(400);
    CHECK(bench.last(Kind::calibration).calibration.status == Status::done);
    CHECK_MESSAGE(bench.eeprom_writes <= 8, "version twice, the value, the checksum");
    CHECK(bench.chip.driving());
}

TEST_CASE("while a store runs, its values stay as they are") {
    Bench bench;
    bench.say(hello(OUR_SESSION));
    const uint16_t crc = bench.chip.calibration().crc();
    bench.say(calibration_store(OUR_SESSION, crc));
    bench.run_ms(30);
    bench.heard.clear();
    bench.say(parameter_write(OUR_SESSION, Parameter::servo_left_us, 1500));
    bench.say(packet_of(Kind::calibration_defaults, OUR_SESSION));
    bench.say(calibration_store(OUR_SESSION, crc));
    CHECK_MESSAGE(bench.heard.empty(), "nobody answers; the host asks again");
    CHECK(bench.chip.calibration().crc() == crc);
    bench.run_ms(200);
    CHECK(bench.last(Kind::calibration).calibration.status == Status::done);
    CHECK(asked(bench, parameter_write(OUR_SESSION, Parameter::servo_left_us, 1500)).status == Status::done);
}

TEST_CASE("the answer to a store waits for room on the line") {
    Bench bench;
    bench.say(hello(OUR_SESSION));
    bench.say(calibration_store(OUR_SESSION, bench.chip.calibration().crc()));
    bench.line_full = true;
    bench.run_ms(400);
    bench.line_full = false;
    bench.run_ms(10);
    CHECK(bench.last(Kind::calibration).calibration.status == Status::done);
}

TEST_CASE("an EEPROM that does not hold what was written is told") {
    Bench bench;
    bench.say(hello(OUR_SESSION));
    bench.eeprom_works = false;
    CHECK(stored(bench, OUR_SESSION, bench.chip.calibration().crc()).status == Status::not_written);
    CHECK(bench.chip.calibration().stored_crc() == 0xFFFF);
    bench.eeprom_works = true;
    CHECK(stored(bench, OUR_SESSION, bench.chip.calibration().crc()).status == Status::done);
}

TEST_CASE("power lost at any moment of a store leaves the old values, the new ones, or the fault; never a mixture") {
    Bench bench;
    bench.say(hello(OUR_SESSION));
    bench.say(parameter_write(OUR_SESSION, Parameter::servo_right_us, 0x0234 + 500));
    bench.say(parameter_write(OUR_SESSION, Parameter::speed_i, 4660));
    REQUIRE(stored(bench, OUR_SESSION, bench.chip.calibration().crc()).status == Status::done);
    const Bytes before = Bench::eeprom();
    const uint16_t crc_before = bench.chip.calibration().crc();
    unsigned old_values = 0, damaged = 0, new_values = 0;
    for (uint32_t cut_ms = 0; cut_ms < 150; ++cut_ms) {
        CAPTURE(cut_ms);
        Bench::eeprom() = before;
        bench.restart();
        bench.say(hello(OUR_SESSION));
        bench.say(parameter_write(OUR_SESSION, Parameter::servo_right_us, 777));
        bench.say(parameter_write(OUR_SESSION, Parameter::speed_i, 0x0999));
        const uint16_t crc_after = bench.chip.calibration().crc();
        bench.say(calibration_store(OUR_SESSION, crc_after));
        bench.run_ms(cut_ms);
        bench.restart();
        if (bench.chip.faults() == fault::CALIBRATION_INVALID) {
            ++damaged;
            CHECK_MESSAGE(Bench::eeprom()[0] == 0, "not the checksum alone tells: the version is that of no layout");
            CHECK(bench.chip.calibration()[Parameter::speed_i] == 1020);
            CHECK(bench.chip.calibration().stored_crc() == 0xFFFF);
        } else {
            CHECK(bench.chip.faults() == 0);
            const uint16_t crc = bench.chip.calibration().crc();
            CHECK((crc == crc_before || crc == crc_after));
            crc == crc_before ? ++old_values : ++new_values;
        }
    }
    CHECK(old_values >= 1);
    CHECK(damaged > 50);
    CHECK(new_values >= 1);
}

TEST_CASE("every damaged bit of the EEPROM is noticed; the car may drive on defaults, and a store mends it") {
    Bench bench;
    bench.say(hello(OUR_SESSION));
    bench.say(parameter_write(OUR_SESSION, Parameter::servo_left_us, 1500));
    REQUIRE(stored(bench, OUR_SESSION, bench.chip.calibration().crc()).status == Status::done);
    for (size_t bit = 0; bit < 100 * 8; ++bit) {
        CAPTURE(bit);
        Bench::eeprom()[bit / 8] ^= static_cast<uint8_t>(1 << bit % 8);
        bench.restart();
        CHECK(bench.chip.faults() == fault::CALIBRATION_INVALID);
        CHECK(bench.chip.calibration()[Parameter::servo_left_us] == 1465);
        Bench::eeprom()[bit / 8] ^= static_cast<uint8_t>(1 << bit % 8);
    }
    Bench::eeprom()[0] = 2;
    bench.restart();
    bench.drive();
    CHECK_MESSAGE(bench.chip.driving(), "it does not stop the car");
    bench.say(hello(3));
    bench.say(fault_clear(3));
    CHECK_MESSAGE(bench.chip.faults() == fault::CALIBRATION_INVALID, "only a new calibration clears it");
    CHECK(stored(bench, 3, bench.chip.calibration().crc()).status == Status::done);
    CHECK(bench.chip.faults() == 0);
    bench.restart();
    CHECK(bench.chip.faults() == 0);
}

TEST_CASE("a value out of range in the EEPROM is damage, even under a right checksum") {
    Bench bench;
    bench.say(hello(OUR_SESSION));
    REQUIRE(stored(bench, OUR_SESSION, bench.chip.calibration().crc()).status == Status::done);
    Bytes& eeprom = Bench::eeprom();
    eeprom[2] = 20;  // a servo at A6, which cannot be switched
    const uint16_t crc = crc16(eeprom.data(), 98);
    eeprom[98] = static_cast<uint8_t>(crc);
    eeprom[99] = static_cast<uint8_t>(crc >> 8);
    bench.restart();
    CHECK(bench.chip.faults() == fault::CALIBRATION_INVALID);
    CHECK(bench.chip.calibration()[Parameter::servo_pin] == 9);
}

TEST_CASE("a blank EEPROM is no fault") {
    Bench bench;
    CHECK(bench.chip.faults() == 0);
    CHECK(bench.chip.calibration()[Parameter::servo_pin] == 9);
    Bench::eeprom()[1] = 24;
    bench.restart();
    CHECK_MESSAGE(bench.chip.faults() == fault::CALIBRATION_INVALID, "half a blank one is");
}
