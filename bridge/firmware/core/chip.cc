// See chip.h.
#include "chip.h"

#include "steering.h"

namespace carril {

namespace {

// No step of the control counts as longer.
constexpr uint32_t LONGEST_STEP_US = 50000;

}  // namespace

void Chip::begin(uint8_t (*eeprom)(uint16_t address), bool watchdog_reset) {
    calibration_.load(eeprom);
    // Pins count from the start of the chip, and so does what depends on them.
    capabilities_ = capability::SPEED_CONTROL | capability::RAW_DUTY | capability::CALIBRATION | capability::TIME_SYNC;
    if (calibration_[Parameter::battery_pin] != NO_PIN) capabilities_ |= capability::BATTERY;
    if (calibration_[Parameter::estop_pin] != NO_PIN) capabilities_ |= capability::ESTOP_INPUT;
    has_channel_b_ = calibration_[Parameter::encoder_b_pin] != NO_PIN;
    if (watchdog_reset) faults_ |= fault::WATCHDOG_RESET;
    if (calibration_.damaged()) faults_ |= fault::CALIBRATION_INVALID;
    set_pins();
}

uint8_t Chip::receive(uint32_t now_us, const uint8_t* bytes, uint8_t size) {
    // First the time, then the bytes: a command that comes after the lease has run out revives nothing.
    expire_lease(now_us);
    // Frames may come in every pass; a job that has waited for one does not wait for the next.
    if (put_off_) return 0;
    HostPacket packet = {};
    for (uint8_t i = 0; i < size; ++i) {
        const Heard heard = decoder_.push(bytes[i], packet);
        if (heard == Heard::nothing) continue;
        took_frame_ = true;
        if (heard == Heard::packet) {
            obey(packet, now_us);
            return static_cast<uint8_t>(i + 1);
        }
        if (heard == Heard::version && packet.kind == Kind::estop) {
            stop(fault::ESTOP_BY_HOST);
        } else if (heard == Heard::version && packet.kind == Kind::hello) {
            answer_hello(0);
            return static_cast<uint8_t>(i + 1);
        } else {
            noise_watch_.count();
        }
    }
    return size;
}

bool Chip::step(uint32_t now_us, const Readings& readings) {
    expire_lease(now_us);
    last_command_.keep(now_us);
    encoder_.read(readings.encoder, now_us);
    backwards_ = readings.encoder.backwards;
    watch_estop(readings);
    put_off_ = took_frame_ && job_is_due(now_us);
    took_frame_ = false;
    if (!put_off_) work(now_us, readings);
    set_pins();
    return job_is_due(now_us);
}

bool Chip::job_is_due(uint32_t now_us) const {
    return telemetry_due_ || static_cast<int32_t>(now_us - next_control_us_) >= 0;
}

void Chip::work(uint32_t now_us, const Readings& readings) {
    if (static_cast<int32_t>(now_us - next_control_us_) >= 0) {
        next_control_us_ += CONTROL_PERIOD_US;
        // After a pause that no chip of ours makes, the steps that were missed are not made up for.
        if (static_cast<int32_t>(now_us - next_control_us_) >= 0) next_control_us_ = now_us + CONTROL_PERIOD_US;
        control(now_us, readings);
        telemetry_is_next_ = !telemetry_is_next_;
        telemetry_due_ = telemetry_is_next_;
    } else if (telemetry_due_) {
        // What finds no room is not sent later: the next one is due soon, and says more.
        telemetry_due_ = false;
        send_telemetry(now_us);
    } else if (storing_) {
        const Calibration::Outcome outcome = calibration_.take_outcome();
        if (outcome != Calibration::Outcome::none) {
            store_status_ = outcome == Calibration::Outcome::stored ? Status::done : Status::not_written;
            if (store_status_ == Status::done) faults_ &= static_cast<uint16_t>(~fault::CALIBRATION_INVALID);
            storing_ = false;
            answer_due_ = true;
        }
    } else if (answer_due_) {
        answer_due_ = !answer_calibration(store_status_);
    }
}

void Chip::obey(const HostPacket& packet, uint32_t now_us) {
    switch (packet.kind) {
        case Kind::hello: greet(packet.session); break;
        case Kind::command:
            if (in_session(packet.session)) take_command(packet, now_us);
            break;
        case Kind::estop: stop(fault::ESTOP_BY_HOST); break;
        case Kind::fault_clear:
            if (in_session(packet.session)) clear_faults();
            break;
        case Kind::release:
            if (in_session(packet.session)) halt();
            break;
        case Kind::time_sync: send(Kind::time_sync_ack, TimeSyncAck{packet.token, now_us, now_us}); break;
        case Kind::parameter_read: answer_parameter(packet.index, Status::done); break;
        case Kind::parameter_write: write_parameter(packet); break;
        case Kind::calibration_store: store_calibration(packet); break;
        case Kind::calibration_defaults: restore_defaults(packet); break;
        case Kind::calibration_query: answer_calibration(Status::done); break;
        default: break;
    }
}

void Chip::greet(uint16_t session) {
    if (!in_session(session)) {
        halt();
        session_ = session;
        session_open_ = true;
    }
    answer_hello(session);
}

void Chip::take_command(const HostPacket& packet, uint32_t now_us) {
    last_command_.set(now_us);
    last_command_seq_ = packet.seq;
    if (stopped()) return;
    steering_tenth_mrad_ = steering_within_limit(calibration_, packet.steering_tenth_mrad);
    servo_held_ = true;
    aim_servo();
    const int16_t limit = static_cast<int16_t>(calibration_[Parameter::full_duty_speed_mm_s]);
    raw_ = packet.raw;
    speed_ = raw_ ? packet.speed : clamp<int16_t>(packet.speed, static_cast<int16_t>(-limit), limit);
    leased_ = true;
    leased_until_us_ = now_us + static_cast<uint32_t>(packet.lease_ms) * 1000;
}

bool Chip::may_calibrate(uint16_t session, Status& status) const {
    status = !in_session(session) ? Status::not_the_open_session : leased_ ? Status::driving : Status::done;
    return status == Status::done;
}

void Chip::write_parameter(const HostPacket& packet) {
    // The values being stored must stay; the host asks again when no answer comes.
    if (storing_) return;
    Status status = Status::no_such_parameter;
    if (packet.index < PARAMETERS && may_calibrate(packet.session, status)) {
        if (!parameter_allows(packet.index, packet.value)) {
            status = Status::out_of_range;
        } else {
            calibration_.set(packet.index, packet.value);
            aim_servo();
        }
    }
    answer_parameter(packet.index, status);
}

void Chip::store_calibration(const HostPacket& packet) {
    // The same order again: it is answered when the store is done.
    if (storing_) return;
    Status status;
    if (may_calibrate(packet.session, status) && packet.crc != calibration_.crc()) status = Status::crc_differs;
    if (status != Status::done) {
        answer_calibration(status);
        return;
    }
    calibration_.store();
    storing_ = true;
}

void Chip::restore_defaults(const HostPacket& packet) {
    if (storing_) return;
    Status status;
    if (may_calibrate(packet.session, status)) {
        calibration_.set_defaults();
        aim_servo();
    }
    answer_calibration(status);
}

template <class Fields>
bool Chip::send(Kind kind, const Fields& fields) {
    Wire wire(kind, next_seq_);
    write(wire, fields);
    wire.finish();
    // A frame that finds no room was never on the line, so it is not missing there.
    if (!line_.send(line_.context, wire.bytes(), wire.size())) return false;
    ++next_seq_;
    return true;
}

void Chip::answer_hello(uint16_t session) {
    send(Kind::hello_ack,
         HelloAck{session, FIRMWARE.major, FIRMWARE.minor, FIRMWARE.patch, capabilities_, calibration_.crc()});
}

bool Chip::answer_parameter(uint8_t index, Status status) {
    if (index >= PARAMETERS) return send(Kind::parameter, ParameterAnswer{index, Status::no_such_parameter, 0});
    return send(Kind::parameter, ParameterAnswer{index, status, calibration_.value(index)});
}

bool Chip::answer_calibration(Status status) {
    return send(Kind::calibration,
                CalibrationAnswer{status, PARAMETERS, calibration_.crc(), calibration_.stored_crc()});
}

bool Chip::send_telemetry(uint32_t now_us) {
    using namespace telemetry_flags;
    Telemetry t = {};
    if (driving()) t.flags |= DRIVING;
    if (session_open_) {
        t.flags |= SESSION;
        t.session = session_;
    }
    t.faults = faults_;
    t.ticks = encoder_.ticks();
    if (encoder_.has_period(now_us)) {
        t.flags |= TICK_PERIOD;
        t.tick_period_us = encoder_.period_us();
    }
    t.speed_mm_s = static_cast<int16_t>(rolling() * encoder_.speed_mm_s());
    t.steering_tenth_mrad = steering_tenth_mrad_;
    if (battery_known_) {
        t.flags |= BATTERY;
        t.battery_mv = battery_mv_;
    }
    if (last_command_.known()) {
        t.flags |= LAST_COMMAND;
        const uint32_t age_us = last_command_.age_us(now_us);
        t.last_seq = last_command_seq_;
        t.last_age_us = static_cast<uint16_t>(age_us < UINT16_MAX ? age_us : UINT16_MAX);
    }
    t.chip_time_us = now_us;
    t.damaged_frames = decoder_.damage().total();
    return send(Kind::telemetry, t);
}

// Brakes and ends the session. The steering stays where it is: centring it in a bend would leave the lane.
void Chip::halt() {
    session_open_ = false;
    last_command_.forget();
    leased_ = false;
    fading_from_ = 0;
    encoder_watch_ = EncoderWatch();
    speed_control_.reset();
    duty_ = 0;
}

void Chip::stop(uint16_t fault) {
    faults_ |= fault;
    halt();
}

void Chip::expire_lease(uint32_t now_us) {
    if (!leased_ || static_cast<int32_t>(now_us - leased_until_us_) < 0) return;
    const int16_t duty = duty_;
    stop(fault::LEASE_EXPIRED);
    if (calibration_[Parameter::lease_ramp_ms] == 0) return;
    fading_from_ = duty;
    fading_since_us_ = leased_until_us_;
    duty_ = fading_duty(now_us);
}

void Chip::watch_estop(const Readings& readings) {
    if ((capabilities_ & capability::ESTOP_INPUT) == 0) return;
    estop_pressed_ = readings.estop_level == (calibration_[Parameter::estop_pressed_level] != 0);
    if (estop_pressed_ && (faults_ & fault::ESTOP_PRESSED) == 0) stop(fault::ESTOP_PRESSED);
}

void Chip::watch_battery(const Readings& readings, uint32_t now_us) {
    if (!readings.battery_known || (capabilities_ & capability::BATTERY) == 0) return;
    // 16 times 1023 counts are full scale; at most 16 368 times 60 000: it fits. To divide by 1023 is to divide by 1024 and to add
    // a 1024th of that; the rest is below 0.1 mV.
    const uint32_t product = readings.battery_counts_16 * static_cast<uint32_t>(calibration_[Parameter::battery_full_scale_mv]);
    battery_mv_ = static_cast<uint16_t>((product + (product >> 10) + 8192) >> 14);
    battery_known_ = true;
    const bool low = battery_watch_.is_low(battery_mv_, calibration_[Parameter::battery_low_mv], now_us);
    if (low && (faults_ & fault::BATTERY_LOW) == 0) stop(fault::BATTERY_LOW);
}

// The one fault that comes and goes by itself.
void Chip::watch_noise(uint32_t now_us) {
    faults_ &= static_cast<uint16_t>(~fault::LINK_NOISY);
    if (noise_watch_.is_noisy(now_us)) faults_ |= fault::LINK_NOISY;
}

// Clears what is latched; what still has its cause stays.
void Chip::clear_faults() {
    uint16_t persists = fault::LINK_NOISY | fault::CALIBRATION_INVALID;
    if (estop_pressed_) persists |= fault::ESTOP_PRESSED;
    const bool battery_low =
        battery_known_ && !BatteryWatch::is_good(battery_mv_, calibration_[Parameter::battery_low_mv]);
    if (battery_low) persists |= fault::BATTERY_LOW;
    faults_ &= persists;
}

void Chip::control(uint32_t now_us, const Readings& readings) {
    encoder_.measure(now_us, calibration_[Parameter::encoder_tick_nm]);
    watch_battery(readings, now_us);
    watch_noise(now_us);
    const uint32_t gone_us = controlled_us_known_ ? now_us - controlled_us_ : 0;
    controlled_us_ = now_us;
    controlled_us_known_ = true;
    duty_ = wanted_duty(now_us, gone_us < LONGEST_STEP_US ? gone_us : LONGEST_STEP_US);
    if (encoder_watch_.is_silent(duty_, encoder_.last_tick(), now_us)) stop(fault::ENCODER_SILENT);
}

int16_t Chip::wanted_duty(uint32_t now_us, uint32_t step_us) {
    if (fading_from_ != 0) return fading_duty(now_us);
    if (!leased_ || stopped()) return 0;
    int16_t duty = raw_ ? speed_control_.push(speed_)
                        : speed_control_.hold(speed_, encoder_.speed_mm_s(), rolling(), step_us, calibration_);
    // What the motor needs before it moves at all.
    const int16_t dead = static_cast<int16_t>(calibration_[Parameter::motor_dead_duty]);
    if (duty > 0) duty = static_cast<int16_t>(duty + dead);
    if (duty < 0) duty = static_cast<int16_t>(duty - dead);
    return clamp<int16_t>(duty, -FULL_DUTY, FULL_DUTY);
}

// After the lease: in a straight line to 0.
int16_t Chip::fading_duty(uint32_t now_us) {
    const uint32_t whole_us = static_cast<uint32_t>(calibration_[Parameter::lease_ramp_ms]) * 1000;
    const uint32_t gone_us = now_us - fading_since_us_;
    if (gone_us >= whole_us) {
        fading_from_ = 0;
        return 0;
    }
    // At most 1020 times one second.
    return static_cast<int16_t>(fading_from_ * static_cast<int32_t>(whole_us - gone_us) /
                                static_cast<int32_t>(whole_us));
}

int8_t Chip::rolling() const {
    if (!has_channel_b_) return speed_control_.direction();
    return backwards_ ? -1 : 1;
}

void Chip::set_pins() {
    const MotorPins& motor = gate_.pass(duty_);
    pins_.motor_pwm = motor.pwm;
    pins_.motor_direction_level = motor.forward == (calibration_[Parameter::motor_forward_level] != 0);
}

void Chip::aim_servo() {
    if (servo_held_) pins_.servo_us = servo_us(calibration_, steering_tenth_mrad_);
}

}  // namespace carril
