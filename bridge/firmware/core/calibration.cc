// See calibration.h. In the EEPROM, from address 0: version u8, count u8, values i32, crc u16 over all before it; little endian.
#include "calibration.h"

namespace carril {

void Calibration::load(uint8_t (*eeprom)(uint16_t address)) {
    const bool blank = eeprom(0) == BLANK && eeprom(1) == BLANK;
    const bool valid = !blank && read(eeprom);
    damaged_ = !blank && !valid;
    if (!valid) set_defaults();
    update_crc();
    stored_crc_ = valid ? crc_ : CRC_START;
}

bool Calibration::read(uint8_t (*eeprom)(uint16_t address)) {
    if (eeprom(0) != LAYOUT_VERSION || eeprom(1) != PARAMETERS) return false;
    Crc16 crc;
    for (uint8_t at = 0; at < CRC_AT; ++at) crc.add(eeprom(at));
    if (eeprom(CRC_AT) != (crc.value() & 0xFF) || eeprom(CRC_AT + 1) != (crc.value() >> 8)) return false;
    for (uint8_t index = 0; index < PARAMETERS; ++index) {
        uint32_t value = 0;
        for (uint8_t byte = 4; byte-- > 0;) {
            value = (value << 8) | eeprom(static_cast<uint16_t>(VALUES_AT + 4 * index + byte));
        }
        values_[index] = static_cast<int32_t>(value);
        if (!parameter_allows(index, values_[index])) return false;
    }
    return true;
}

void Calibration::set(uint8_t index, int32_t value) {
    values_[index] = value;
    update_crc();
}

void Calibration::set_defaults() {
    for (uint8_t index = 0; index < PARAMETERS; ++index) values_[index] = parameter_default(index);
    update_crc();
}

// In memory the values are as in the EEPROM and under the checksum; shifting 32 bits byte by byte would cost the AVR 1 ms.
static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "the AVR is little endian, and so is every host we test on");

uint8_t Calibration::value_byte(uint8_t offset) const { return reinterpret_cast<const uint8_t*>(values_)[offset]; }

void Calibration::update_crc() { crc_ = crc16(reinterpret_cast<const uint8_t*>(values_), sizeof values_); }

uint8_t Calibration::byte_at(uint8_t address) const {
    if (address == 0) return LAYOUT_VERSION;
    if (address == 1) return PARAMETERS;
    if (address < CRC_AT) return value_byte(static_cast<uint8_t>(address - VALUES_AT));
    return static_cast<uint8_t>(address == CRC_AT ? layout_crc_ : layout_crc_ >> 8);
}

void Calibration::store() {
    Crc16 crc;
    for (uint8_t address = 0; address < CRC_AT; ++address) crc.add(byte_at(address));
    layout_crc_ = crc.value();
    stored_crc_ = CRC_START;
    at_ = 0;
    tries_ = 0;
    outcome_ = Outcome::none;
}

uint16_t Calibration::address() const { return at_ == BYTES ? 0 : at_; }

bool Calibration::wants(uint8_t present, uint8_t& wanted) {
    wanted = at_ == 0 ? UNFINISHED : byte_at(static_cast<uint8_t>(address()));
    if (present != wanted) {
        if (tries_++ < MOST_TRIES) return true;
        at_ = IDLE;
        outcome_ = Outcome::failed;
        return false;
    }
    tries_ = 0;
    if (at_++ < BYTES) return false;
    at_ = IDLE;
    stored_crc_ = crc_;
    damaged_ = false;
    outcome_ = Outcome::stored;
    return false;
}

Calibration::Outcome Calibration::take_outcome() {
    const Outcome outcome = outcome_;
    outcome_ = Outcome::none;
    return outcome;
}

}  // namespace carril
