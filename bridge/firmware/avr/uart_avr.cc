// See uart_avr.h.
#include "uart_avr.h"

#include <avr/interrupt.h>
#include <avr/io.h>

namespace carril {

namespace {

// 128 bytes are 2.5 ms of the line. A power of two below 256, so that indices are bytes and wrap with a mask.
constexpr uint8_t RING_BYTES = 128;
constexpr uint8_t RING_MASK = RING_BYTES - 1;

// One side moves `head`, the other `tail`; each is one byte, so that neither needs to lock the other out.
struct Ring {
    uint8_t bytes[RING_BYTES];
    volatile uint8_t head;
    volatile uint8_t tail;
};
Ring received;
Ring to_send;

// Other threads of control never see a byte before it is there.
void compiler_barrier() { __asm__ __volatile__("" ::: "memory"); }

ISR(USART_RX_vect) {
    const uint8_t byte = UDR0;
    const uint8_t head = received.head;
    const uint8_t next = (head + 1) & RING_MASK;
    if (next == received.tail) return;
    received.bytes[head] = byte;
    received.head = next;
}

ISR(USART_UDRE_vect) {
    const uint8_t tail = to_send.tail;
    UDR0 = to_send.bytes[tail];
    const uint8_t next = (tail + 1) & RING_MASK;
    to_send.tail = next;
    if (next == to_send.head) UCSR0B &= static_cast<uint8_t>(~_BV(UDRIE0));
}

}  // namespace

void uart_begin() {
    UCSR0A = _BV(U2X0);
    UBRR0 = 3;  // 16 MHz / 8 / (3 + 1) = 500 000 baud, exactly
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
    UCSR0B = _BV(RXEN0) | _BV(TXEN0) | _BV(RXCIE0);
}

uint8_t uart_received(const uint8_t*& bytes, uint8_t most) {
    const uint8_t tail = received.tail;
    const uint8_t head = received.head;
    compiler_barrier();
    // Up to the end of the ring: what has wrapped comes next time.
    const uint8_t size = static_cast<uint8_t>((head < tail ? RING_BYTES : head) - tail);
    bytes = received.bytes + tail;
    return size < most ? size : most;
}

void uart_drop(uint8_t size) {
    compiler_barrier();
    received.tail = (received.tail + size) & RING_MASK;
}

bool uart_send(const uint8_t* bytes, uint8_t size) {
    uint8_t head = to_send.head;
    const uint8_t used = (head - to_send.tail) & RING_MASK;
    if (size > RING_MASK - used) return false;
    for (uint8_t i = 0; i < size; ++i) {
        to_send.bytes[head] = bytes[i];
        head = (head + 1) & RING_MASK;
    }
    compiler_barrier();
    to_send.head = head;
    // The interrupt takes its own bit away: this one instruction and a half must not be cut in two.
    const uint8_t state = SREG;
    cli();
    UCSR0B |= _BV(UDRIE0);
    SREG = state;
    return true;
}

}  // namespace carril
