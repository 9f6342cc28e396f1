// The core of the firmware on this machine, behind the same requests and replies as simulator/simulated_chip.c has for the whole
// firmware: so that tests compare it with the model over many conversations, fast. The pins, the line and the EEPROM are ideal:
// bytes come and go at once. Never looks at the wall clock. Pin options are taken and ignored: a core has no pin numbers.
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <string>
#include <vector>

#include "../core/chip.h"

namespace {

using carril::Chip;
using carril::Parameter;

constexpr uint32_t CYCLES_PER_US = 16;
// No step of time is longer: finer than the 5 ms of the control, so that a lease ends where it should.
constexpr uint32_t STEP_US = 500;
constexpr uint32_t SERVO_PERIOD_US = 18000;
constexpr uint32_t WATCHDOG_US = 64000;
// The converter has its first mean.
constexpr uint64_t BATTERY_KNOWN_AFTER_US = 2000;
constexpr size_t EEPROM_BYTES = 1024;

enum EventKind : uint8_t {
    SENT_BYTE = 1,
    MOTOR_DUTY = 2,
    DIRECTION = 3,
    RESET_PIN = 4,
    SERVO_PULSE = 5,
    WATCHDOG = 7,
    LONGEST_PASS = 9,
};

struct Event {
    uint64_t cycles;
    uint8_t kind;
    uint32_t value;
};

[[noreturn]] void give_up(const std::string& message) {
    fprintf(stderr, "chip-on-host: %s\n", message.c_str());
    exit(1);
}

uint8_t eeprom[EEPROM_BYTES];

uint8_t read_eeprom(uint16_t address) { return eeprom[address % EEPROM_BYTES]; }

// The wheel: edges at their exact times, however time is cut.
class Wheel {
public:
    void turn(float edges_per_s) { per_us_ = llround(static_cast<double>(edges_per_s) * (1 << 20)); }

    void run(uint64_t from_us, uint32_t micros, uint32_t chip_now_us) {
        position_ += per_us_ * micros;
        int64_t crossed = position_ / EDGE;
        if (position_ < 0) crossed -= 1;
        position_ -= crossed * EDGE;
        if (crossed == 0) return;
        const int64_t since_units = per_us_ > 0 ? position_ : EDGE - position_;
        const uint64_t at_us = from_us + micros - static_cast<uint64_t>(since_units / llabs(per_us_));
        const uint64_t n = static_cast<uint64_t>(llabs(crossed));
        const uint64_t period_us =
            n > 1 || !known_ ? static_cast<uint64_t>(EDGE / llabs(per_us_)) : at_us - last_at_us_;
        reading.ticks += static_cast<uint32_t>(n);
        total += static_cast<uint32_t>(n);
        reading.last_tick_us = chip_now_us - static_cast<uint32_t>(from_us + micros - at_us);
        reading.period_us = static_cast<uint32_t>(period_us);
        reading.backwards = per_us_ < 0;
        known_ = true;
        last_at_us_ = at_us;
    }

    void restart_chip() { reading = {}; }

    carril::EncoderReading reading = {};
    uint32_t total = 0;

private:
    static constexpr int64_t EDGE = 1000000LL << 20;
    int64_t position_ = 0;
    int64_t per_us_ = 0;
    uint64_t last_at_us_ = 0;
    bool known_ = false;
};

class Bench {
public:
    Bench() { power_on(false); }

    void power_on(bool by_watchdog) {
        chip_ = Chip(carril::Line{send, this});
        started_us_ = now_us_;
        next_servo_us_ = now_us_ + SERVO_PERIOD_US;
        hung_ = false;
        wheel_.restart_chip();
        chip_.begin(read_eeprom, by_watchdog);
        has_reset_pin_ = chip_.calibration()[Parameter::motor_reset_pin] != carril::NO_PIN;
        look_at_pins();
    }

    void hang() {
        hung_ = true;
        hung_since_us_ = now_us_;
    }

    void advance(uint32_t micros, float edges_per_s, uint16_t battery_mv, bool pressed, const std::vector<uint8_t>& bytes) {
        wheel_.turn(edges_per_s);
        battery_mv_ = battery_mv;
        pressed_ = pressed;
        if (!hung_) {
            for (const uint8_t& byte : bytes) {
                chip_.receive(chip_time_us(), &byte, 1);
                if (chip_.calibration().storing()) store();
            }
        }
        const uint64_t end_us = now_us_ + micros;
        step();
        while (now_us_ < end_us) {
            const uint32_t part = static_cast<uint32_t>(end_us - now_us_ < STEP_US ? end_us - now_us_ : STEP_US);
            wheel_.run(now_us_, part, chip_time_us() + part);
            now_us_ += part;
            step();
        }
        note(LONGEST_PASS, 0);
    }

    uint64_t now_cycles() const { return now_us_ * CYCLES_PER_US; }
    uint32_t edges() const { return wheel_.total; }
    std::vector<Event> take_events() {
        std::vector<Event> events;
        events.swap(events_);
        return events;
    }

private:
    static bool send(void* bench, const uint8_t* bytes, uint8_t size) {
        for (uint8_t i = 0; i < size; ++i) static_cast<Bench*>(bench)->note(SENT_BYTE, bytes[i]);
        return true;
    }

    uint32_t chip_time_us() const { return static_cast<uint32_t>(now_us_ - started_us_); }

    void note(uint8_t kind, uint32_t value) { events_.push_back({now_cycles(), kind, value}); }

    void step() {
        if (hung_ && now_us_ - hung_since_us_ >= WATCHDOG_US) {
            note(WATCHDOG, 0);
            power_on(true);
        }
        if (!hung_) {
            while (chip_.step(chip_time_us(), readings())) {
            }
            look_at_pins();
        }
        pulse_servo();
    }

    carril::Readings readings() const {
        // As simavr's converter: 5 V are 1023 counts, rounded down.
        const uint32_t pin_mv = battery_mv_ * 5000U / 15000U;
        const uint32_t counts = pin_mv < 5000 ? pin_mv * 1023 / 5000 : 1023;
        const bool pressed_level = chip_.calibration()[Parameter::estop_pressed_level] != 0;
        return {wheel_.reading, static_cast<uint16_t>(16 * counts), now_us_ - started_us_ >= BATTERY_KNOWN_AFTER_US,
                pressed_ == pressed_level};
    }

    // An EEPROM that takes no time, so that the answer comes as soon as the model's.
    void store() {
        while (chip_.calibration().storing()) {
            uint8_t& present = eeprom[chip_.calibration().address()];
            uint8_t wanted;
            if (chip_.eeprom(present, wanted)) present = wanted;
        }
        // One step takes the outcome, one answers; the control or a report may come first.
        for (int i = 0; i < 4; ++i) chip_.step(chip_time_us(), readings());
        look_at_pins();
    }

    void look_at_pins() {
        note_change(last_duty_, chip_.pins().motor_pwm, MOTOR_DUTY);
        note_change(last_direction_, chip_.pins().motor_direction_level, DIRECTION);
        note_change(last_reset_, has_reset_pin_, RESET_PIN);
    }

    void note_change(uint32_t& last, uint32_t value, uint8_t kind) {
        if (last != value) note(kind, value);
        last = value;
    }

    void pulse_servo() {
        if (now_us_ < next_servo_us_) return;
        if (pulse_us_ == 0) {
            // A pulse begins, and keeps the width that it began with.
            pulse_us_ = hung_ ? 0 : chip_.pins().servo_us;
            next_servo_us_ += pulse_us_ != 0 ? pulse_us_ : SERVO_PERIOD_US;
            return;
        }
        events_.push_back({next_servo_us_ * CYCLES_PER_US, SERVO_PULSE, pulse_us_ * CYCLES_PER_US});
        next_servo_us_ += SERVO_PERIOD_US - pulse_us_;
        pulse_us_ = 0;
    }

    Chip chip_{carril::Line{send, this}};
    Wheel wheel_;
    std::vector<Event> events_;
    uint64_t now_us_ = 0;
    uint64_t started_us_ = 0;
    uint64_t next_servo_us_ = 0;
    uint32_t pulse_us_ = 0;
    uint64_t hung_since_us_ = 0;
    bool hung_ = false;
    uint16_t battery_mv_ = 0;
    bool pressed_ = false;
    bool has_reset_pin_ = false;
    uint32_t last_duty_ = 0;
    uint32_t last_direction_ = 0;
    uint32_t last_reset_ = 0;
};

void read_exactly(void* bytes, size_t size) {
    if (size > 0 && fread(bytes, size, 1, stdin) != 1) give_up("a request was cut off");
}

uint32_t read_number(size_t size) {
    uint8_t raw[4];
    read_exactly(raw, size);
    uint32_t value = 0;
    for (size_t i = size; i-- > 0;) value = value << 8 | raw[i];
    return value;
}

void write_number(uint64_t value, unsigned size) {
    for (unsigned i = 0; i < size; ++i) putchar(static_cast<int>(value >> (8 * i) & 0xFF));
}

void advance(Bench& bench) {
    const uint32_t micros = read_number(4);
    const uint32_t rate_bits = read_number(4);
    float edges_per_s;
    memcpy(&edges_per_s, &rate_bits, sizeof edges_per_s);
    const uint32_t battery_mv = read_number(2);
    const uint32_t pressed = read_number(1);
    std::vector<uint8_t> bytes(read_number(2));
    read_exactly(bytes.data(), bytes.size());
    if (!(fabsf(edges_per_s) <= 1e6F)) give_up("`encoder_edges_per_s` is out of range, expected -1e6 to 1e6");
    if (pressed > 1) give_up("`estop_pressed` is neither 0 nor 1");
    bench.advance(micros, edges_per_s, static_cast<uint16_t>(battery_mv), pressed != 0, bytes);

    putchar('a');
    write_number(bench.now_cycles(), 8);
    write_number(bench.edges(), 4);
    const std::vector<Event> events = bench.take_events();
    write_number(events.size(), 4);
    for (const Event& event : events) {
        write_number(event.cycles, 8);
        write_number(event.kind, 1);
        write_number(event.value, 4);
    }
}

void check_options(int argc, char** argv) {
    static const char* const known[] = {"--elf",           "--loop-address", "--servo-pin",   "--motor-pwm-pin",
                                        "--motor-direction-pin", "--motor-reset-pin", "--encoder-pin",
                                        "--encoder-b-pin", "--estop-pin",    "--estop-pressed-level", "--battery-pin"};
    for (int i = 1; i < argc; i += 2) {
        bool found = false;
        for (const char* name : known) found = found || strcmp(argv[i], name) == 0;
        if (!found || i + 1 == argc) give_up(std::string("unknown option or no value: `") + argv[i] + "`");
    }
}

}  // namespace

int main(int argc, char** argv) {
    check_options(argc, argv);
    memset(eeprom, 0xFF, sizeof eeprom);
    Bench bench;
    int request;
    while ((request = getchar()) != EOF) {
        switch (request) {
            case 'A': advance(bench); break;
            case 'P':
                bench.power_on(false);
                putchar('p');
                break;
            case 'J':
                bench.hang();
                putchar('j');
                break;
            case 'E':
                putchar('e');
                fwrite(eeprom, sizeof eeprom, 1, stdout);
                break;
            case 'W':
                read_exactly(eeprom, sizeof eeprom);
                putchar('w');
                break;
            default: give_up("unknown request, expected A, P, J, E or W");
        }
        if (fflush(stdout) != 0) return 1;
    }
    return 0;
}
