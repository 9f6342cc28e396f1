// The values of the parameters: those in force, and how they come from and go to an EEPROM. Never waits for the EEPROM: it says
// which byte it wants where, and goes on when asked again.
#pragma once

#include "crc16.h"
#include "parameters.h"

namespace carril {

class Calibration {
public:
    // Takes over what is stored; when that is nothing or damaged, the defaults.
    void load(uint8_t (*eeprom)(uint16_t address));

    int32_t operator[](Parameter parameter) const { return values_[static_cast<uint8_t>(parameter)]; }
    int32_t value(uint8_t index) const { return values_[index]; }

    // The parameter must exist and allow the value.
    void set(uint8_t index, int32_t value);
    void set_defaults();

    uint16_t crc() const { return crc_; }
    // Of what is stored; 0xFFFF when that is nothing valid.
    uint16_t stored_crc() const { return stored_crc_; }
    // Something was stored and cannot be used.
    bool damaged() const { return damaged_; }

    // Begins to store the values in force.
    void store();
    // While it stores: neither `set` nor `set_defaults` may be called.
    bool storing() const { return at_ != IDLE; }
    // The byte of the EEPROM that is dealt with now.
    uint16_t address() const;
    // The EEPROM is ready and holds `present` at `address`. True: write `wanted` there. Ask again when it is ready.
    bool wants(uint8_t present, uint8_t& wanted);
    // Ends once with one of these after `store`.
    enum class Outcome : uint8_t { none, stored, failed };
    Outcome take_outcome();

private:
    static constexpr uint8_t LAYOUT_VERSION = 1;
    // While a store runs, this stands in place of the version: neither blank nor valid, should the power fail.
    static constexpr uint8_t UNFINISHED = 0;
    static constexpr uint8_t BLANK = 0xFF;
    static constexpr uint8_t VALUES_AT = 2;
    static constexpr uint8_t CRC_AT = VALUES_AT + 4 * PARAMETERS;
    static constexpr uint8_t BYTES = CRC_AT + 2;
    static constexpr uint8_t IDLE = 0xFF;
    static constexpr uint8_t MOST_TRIES = 3;

    bool read(uint8_t (*eeprom)(uint16_t address));
    uint8_t value_byte(uint8_t offset) const;
    uint8_t byte_at(uint8_t address) const;
    void update_crc();

    int32_t values_[PARAMETERS] = {};
    uint16_t crc_ = CRC_START;
    uint16_t stored_crc_ = CRC_START;
    bool damaged_ = false;
    // 0: the version is made invalid; 1 to BYTES - 1: the bytes there; BYTES: the version becomes valid.
    uint8_t at_ = IDLE;
    uint8_t tries_ = 0;
    uint16_t layout_crc_ = 0;
    Outcome outcome_ = Outcome::none;
};

}  // namespace carril
