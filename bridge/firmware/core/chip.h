// The whole firmware but its registers: bytes, times and readings in; frames and pins out. Its rules are those of
// bridge/protocol.md, as in bridge/src/mcu_model.rs. Never waits, never allocates, never touches hardware.
//
// In each pass of the main loop: `receive` with the bytes that have come, `step`, then `pins` go to the hardware; and when the
// EEPROM is ready and `calibration().storing()`, `eeprom`.
#pragma once

#include "calibration.h"
#include "decoder.h"
#include "encoder.h"
#include "motor_pins.h"
#include "numbers.h"
#include "speed_control.h"
#include "watch.h"

namespace carril {

// Bits of `faults`; numbers are never reused.
namespace fault {
constexpr uint16_t LEASE_EXPIRED = 1 << 0;
constexpr uint16_t ESTOP_PRESSED = 1 << 1;
constexpr uint16_t ESTOP_BY_HOST = 1 << 2;
constexpr uint16_t BATTERY_LOW = 1 << 3;
constexpr uint16_t ENCODER_SILENT = 1 << 4;
constexpr uint16_t WATCHDOG_RESET = 1 << 5;
constexpr uint16_t CALIBRATION_INVALID = 1 << 6;
constexpr uint16_t LINK_NOISY = 1 << 7;
// Those that stop the motor. The others are told and the car goes on.
constexpr uint16_t STOPPING =
    LEASE_EXPIRED | ESTOP_PRESSED | ESTOP_BY_HOST | BATTERY_LOW | ENCODER_SILENT | WATCHDOG_RESET;
}  // namespace fault

namespace capability {
constexpr uint16_t SPEED_CONTROL = 1 << 0;
constexpr uint16_t BATTERY = 1 << 1;
constexpr uint16_t ESTOP_INPUT = 1 << 2;
constexpr uint16_t RAW_DUTY = 1 << 3;
constexpr uint16_t CALIBRATION = 1 << 4;
constexpr uint16_t TIME_SYNC = 1 << 5;
}  // namespace capability

struct FirmwareVersion {
    uint8_t major;
    uint8_t minor;
    uint8_t patch;
};
constexpr FirmwareVersion FIRMWARE = {0, 1, 0};

constexpr uint32_t CONTROL_PERIOD_US = 5000;
constexpr uint32_t TELEMETRY_PERIOD_US = 10000;

// What the sensors say in this pass.
struct Readings {
    EncoderReading encoder;
    // Mean of the converter, 1/16 of its counts. Only with `battery_known`.
    uint16_t battery_counts_16;
    bool battery_known;
    // Level of the e-stop's pin; without such a pin it does not count.
    bool estop_level;
};

// What the pins shall do until the next pass.
struct Pins {
    // 0: no pulses, the servo is free.
    uint16_t servo_us;
    uint8_t motor_pwm;
    bool motor_direction_level;
};

// Where frames go. `send` takes a whole frame or refuses it when there is no room; it never waits.
struct Line {
    bool (*send)(void* context, const uint8_t* bytes, uint8_t size);
    void* context;
};

class Chip {
public:
    explicit Chip(Line line) : line_(line) {}

    // The start: loads the calibration. Time begins at 0.
    void begin(uint8_t (*eeprom)(uint16_t address), bool watchdog_reset);

    // Takes bytes that have come until `now_us`, but no more than one whole frame, to keep the pass short. Gives how many it
    // took, which may be none; the others are to be given again after the next step.
    uint8_t receive(uint32_t now_us, const uint8_t* bytes, uint8_t size);

    // Lets time pass. At most one of the longer jobs (control, telemetry) runs in a step, and none in the step after a frame, to
    // keep the pass short. True: one is left to do.
    bool step(uint32_t now_us, const Readings& readings);

    const Pins& pins() const { return pins_; }

    // See Calibration::wants.
    bool eeprom(uint8_t present, uint8_t& wanted) { return calibration_.wants(present, wanted); }

    const Calibration& calibration() const { return calibration_; }
    uint16_t faults() const { return faults_; }
    bool driving() const { return session_open_ && leased_ && !stopped(); }
    const DamageCounts& damage() const { return decoder_.damage(); }

    // Another line from now on.
    void connect(Line line) { line_ = line; }

private:
    bool stopped() const { return (faults_ & fault::STOPPING) != 0; }
    bool in_session(uint16_t session) const { return session_open_ && session == session_; }

    void obey(const HostPacket& packet, uint32_t now_us);
    void greet(uint16_t session);
    void take_command(const HostPacket& packet, uint32_t now_us);
    void write_parameter(const HostPacket& packet);
    void store_calibration(const HostPacket& packet);
    void restore_defaults(const HostPacket& packet);
    bool may_calibrate(uint16_t session, Status& status) const;

    template <class Fields>
    bool send(Kind kind, const Fields& fields);
    void answer_hello(uint16_t session);
    bool answer_parameter(uint8_t index, Status status);
    bool answer_calibration(Status status);
    bool send_telemetry(uint32_t now_us);

    void halt();
    void stop(uint16_t fault);
    void expire_lease(uint32_t now_us);
    void watch_estop(const Readings& readings);
    void watch_battery(const Readings& readings, uint32_t now_us);
    void watch_noise(uint32_t now_us);
    void clear_faults();

    bool job_is_due(uint32_t now_us) const;
    void work(uint32_t now_us, const Readings& readings);
    void control(uint32_t now_us, const Readings& readings);
    int16_t wanted_duty(uint32_t now_us, uint32_t step_us);
    int16_t fading_duty(uint32_t now_us);
    int8_t rolling() const;
    void set_pins();
    void aim_servo();

    Line line_;
    Calibration calibration_;
    Decoder<HostPacket> decoder_;
    uint16_t next_seq_ = 0;
    uint16_t capabilities_ = 0;
    bool has_channel_b_ = false;

    uint16_t session_ = 0;
    bool session_open_ = false;
    uint16_t faults_ = 0;

    Moment last_command_;
    uint16_t last_command_seq_ = 0;
    // A command is in force.
    bool leased_ = false;
    bool raw_ = false;
    int16_t speed_ = 0;
    uint32_t leased_until_us_ = 0;
    // After the lease the duty falls to 0 from here. 0: it does not.
    int16_t fading_from_ = 0;
    uint32_t fading_since_us_ = 0;
    int16_t steering_tenth_mrad_ = 0;
    bool servo_held_ = false;

    Encoder encoder_;
    bool backwards_ = false;
    SpeedControl speed_control_;
    EncoderWatch encoder_watch_;
    BatteryWatch battery_watch_;
    NoiseWatch noise_watch_;
    uint16_t battery_mv_ = 0;
    bool battery_known_ = false;
    bool estop_pressed_ = false;

    uint32_t next_control_us_ = 0;
    uint32_t controlled_us_ = 0;
    bool controlled_us_known_ = false;
    bool telemetry_is_next_ = false;
    bool telemetry_due_ = false;
    bool took_frame_ = false;
    bool put_off_ = false;
    bool storing_ = false;
    bool answer_due_ = false;
    Status store_status_ = Status::done;

    int16_t duty_ = 0;
    MotorGate gate_;
    Pins pins_ = {0, 0, false};
};

}  // namespace carril
