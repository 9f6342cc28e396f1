// The serial port: 500 000 baud, 8N1, a ring of bytes each way, filled and emptied in interrupts. Never waits: what finds no room
// is refused (sent) or lost (received; the checksum finds it).
#pragma once

#include <stdint.h>

namespace carril {

void uart_begin();
// Bytes that have come, at most `most`, and where they are; they stay until `uart_drop`. More may be there after that.
uint8_t uart_received(const uint8_t*& bytes, uint8_t most);
void uart_drop(uint8_t size);
// All of it or, when there is no room for all, nothing.
bool uart_send(const uint8_t* bytes, uint8_t size);

}  // namespace carril
