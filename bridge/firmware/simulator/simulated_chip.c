// Runs the unchanged ELF of the firmware in a simulated ATmega328P, and lets another program drive its world over stdin and
// stdout, in the chip's own time. Never looks at the wall clock, and never changes what the firmware does.
//
// SPDX-License-Identifier: GPL-3.0-or-later
// This program is linked with simavr, which is under the GNU General Public License, version 3 or later; so the linked program
// is under that licence too. It is a program of its own: carril never links it, it only runs it in tests.
//
// Requests and replies, little endian; one reply to each request, and the end of stdin ends the program:
//   'A' u32 micros, f32 encoder_edges_per_s (negative: backwards), u16 battery_mv, u8 estop_pressed, u16 n, n bytes
//       The chip runs for so long. The bytes come in on its UART from now on, back to back; what does not fit goes on coming in
//       the next advance.
//       -> 'a' u64 now_cycles, u32 edges_injected_total, u32 n_events, then each event: u64 cycles, u8 kind, u32 value
//   'P' power off and on; the EEPROM stays -> 'p'        'J' the chip hangs, interrupts off -> 'j'
//   'E' -> 'e', the 1024 bytes of the EEPROM             'W' 1024 bytes for the EEPROM -> 'w'
// Kinds of events are in `enum event_kind`.
//
// Where simavr 1.6 is not like the chip, this program puts its own in place:
// - UART: simavr counts a parity bit into each byte (11 bits instead of 10), has a buffer of 64 bytes that hides overruns, and
//   holds one byte for sending instead of two. Here: the datasheet's buffers, bytes of ten bits.
// - EEPROM: simavr writes in no time. Here a write takes 3.4 ms, and the chip sees that it does.
// - Inputs with a pull-up: simavr forgets the level from outside whenever the port is written. Here it is kept.
// - INT0 and INT1 held low before they are configured would fire for ever: turned off.
// - Entering an interrupt takes no time in simavr. Here it takes the datasheet's four cycles.
// Not like the chip, and left so: a new PWM width counts at once, not from the next PWM period (128 us) on.
#include <errno.h>
#include <fcntl.h>
#include <gelf.h>
#include <getopt.h>
#include <libelf.h>
#include <math.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include <simavr/avr_adc.h>
#include <simavr/avr_eeprom.h>
#include <simavr/avr_extint.h>
#include <simavr/avr_ioport.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <simavr/sim_interrupts.h>
#include <simavr/sim_irq.h>

enum { CYCLES_PER_US = 16, FREQUENCY = 16000000, EEPROM_BYTES = 1024, NO_PIN = 255, SUPPLY_MV = 5000 };
// At the battery, when the converter reads its end: the voltage divider of the car.
enum { BATTERY_FULL_SCALE_MV = 15000 };
enum { EEPROM_WRITE_CYCLES = 3400 * CYCLES_PER_US, INTERRUPT_CYCLES = 4, VECTORS_END = 26 * 4 };
// Somewhere in the flash that no firmware of 16 KiB reaches; holds `rjmp .-2` for 'J'.
enum { TRAP_ADDRESS = 0x7F00, ENDLESS_LOOP = 0xCFFF };
#define NEVER UINT64_MAX
#define LOOP_SYMBOL "main_loop_pass"

enum event_kind {
    EVENT_SENT_BYTE = 1,    // its end on the line
    EVENT_MOTOR_DUTY = 2,   // 0 to 255; 0 also when the timer has no say and the pin is low
    EVENT_DIRECTION = 3,    // level
    EVENT_RESET_PIN = 4,    // level
    EVENT_SERVO_PULSE = 5,  // width in cycles, at its end
    EVENT_OVERRUN = 6,      // a received byte is lost, because nobody has read those before
    EVENT_WATCHDOG = 7,     // the watchdog has reset the chip
    EVENT_CRASH = 8,        // the processor has stopped; only 'P' starts it again
    EVENT_LONGEST_PASS = 9, // of the main loop in this advance, cycles; at its end
};

// Registers of the ATmega328P, data addresses.
enum {
    PINB = 0x23, DDRB = 0x24, PORTB = 0x25, DDRC = 0x27, PORTC = 0x28, DDRD = 0x2A, PORTD = 0x2B,
    EECR = 0x3F, TCCR0A = 0x44, OCR0A = 0x47, OCR0B = 0x48, MCUSR = 0x54,
    TCCR2A = 0xB0, OCR2A = 0xB3, OCR2B = 0xB4,
    UCSR0A = 0xC0, UCSR0B = 0xC1, UBRR0L = 0xC4, UBRR0H = 0xC5, UDR0 = 0xC6,
};
enum { EEPE = 1 << 1, PORF = 1 << 0 };
enum { RXC = 1 << 7, TXC = 1 << 6, UDRE = 1 << 5, DOR = 1 << 3, U2X = 1 << 1 };
enum { RXCIE = 1 << 7, UDRIE = 1 << 5, RXEN = 1 << 4, TXEN = 1 << 3 };

struct event {
    uint64_t cycles;
    uint8_t kind;
    uint32_t value;
};

struct pins {
    unsigned servo, motor_pwm, motor_direction, motor_reset, encoder, encoder_b, estop, estop_pressed_level, battery;
};

// The chip's UART, as in the datasheet: two bytes received and a third in the shift register, one waiting to be sent.
struct uart {
    avr_uart_t *simavr;
    uint8_t received[2];
    unsigned n_received;
    bool shift_full;
    uint8_t shift;
    bool overrun;
    bool sending;
    uint8_t sent_byte;
    uint64_t sent_at;
    bool holding;
    uint8_t held;
    // Bytes on their way to the chip.
    uint8_t *line;
    size_t line_begin, line_end, line_room;
    bool byte_begun;
    uint64_t line_at; // the end of the byte on the line; when there is none, from when on there may be one
};

// The wheel. In units so fine that the rate of any f32 is a whole number of them per cycle, and time may be cut anywhere.
#define EDGE_UNITS ((int64_t)FREQUENCY << 20)
#define HALF_EDGE (EDGE_UNITS / 2)
struct wheel {
    int64_t position;
    int64_t per_cycle;
    uint64_t as_of;
    int64_t half_edges; // floor(position / HALF_EDGE)
    uint32_t edges;
    uint64_t next_at;
};

static avr_t *avr;
static avr_run_t run_normally;
static struct pins pins = {9, 11, 4, 7, 2, NO_PIN, 8, 0, 14};
static struct uart uart;
static struct wheel wheel;
static struct event *events;
static size_t n_events, room_for_events;
static uint64_t target_cycles; // how far the driver has let time go
static uint64_t eeprom_done_at = NEVER;
static bool pins_changed;
static uint32_t last_duty, last_direction, last_reset, last_servo;
static uint64_t servo_rose_at;
static bool crashed;
static uint32_t loop_address;
static uint64_t pass_began_at, longest_pass;
static bool pass_running;
static bool estop_pressed;
static uint32_t battery_pin_mv;

__attribute__((noreturn, format(printf, 1, 2))) static void give_up(const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    fputs("simulated-chip: ", stderr);
    vfprintf(stderr, format, arguments);
    fputc('\n', stderr);
    va_end(arguments);
    exit(1);
}

static void log_errors(avr_t *chip, const int level, const char *format, va_list arguments) {
    (void)chip;
    if (level <= LOG_ERROR) vfprintf(stderr, format, arguments);
}

static void note(uint64_t cycles, uint8_t kind, uint32_t value) {
    if (n_events == room_for_events) {
        room_for_events = room_for_events ? 2 * room_for_events : 1024;
        events = realloc(events, room_for_events * sizeof *events);
        if (!events) give_up("out of memory");
    }
    events[n_events++] = (struct event){cycles, kind, value};
}

// ---- UART ----

static uint64_t byte_cycles(void) {
    const uint32_t divisor = avr->data[UBRR0L] | (avr->data[UBRR0H] & 0x0F) << 8;
    const uint32_t per_bit = (avr->data[UCSR0A] & U2X ? 8 : 16) * (divisor + 1);
    return 10 * per_bit;
}

// Both interrupts of the UART depend on a level: they come again until their cause is gone.
static void keep_pending(avr_int_vector_t *vector, bool wanted) {
    if (wanted && !vector->pending) avr_raise_interrupt(avr, vector);
    if (!wanted && vector->pending) vector->pending = 0;
}

static void uart_update(void) {
    const uint8_t control = avr->data[UCSR0B];
    keep_pending(&uart.simavr->rxc, (control & RXCIE) && uart.n_received > 0);
    keep_pending(&uart.simavr->udrc, (control & UDRIE) && !uart.holding);
}

static uint8_t uart_read_data(avr_t *chip, avr_io_addr_t address, void *nothing) {
    (void)chip, (void)address, (void)nothing;
    if (uart.n_received == 0) return 0;
    const uint8_t byte = uart.received[0];
    uart.received[0] = uart.received[1];
    --uart.n_received;
    if (uart.shift_full) {
        uart.received[uart.n_received++] = uart.shift;
        uart.shift_full = false;
    }
    uart.overrun = false;
    uart_update();
    return byte;
}

static void uart_begin_sending(uint8_t byte, uint64_t at) {
    uart.sending = true;
    uart.sent_byte = byte;
    uart.sent_at = at + byte_cycles();
}

static void uart_write_data(avr_t *chip, avr_io_addr_t address, uint8_t byte, void *nothing) {
    (void)address, (void)nothing;
    if (!(chip->data[UCSR0B] & TXEN)) return;
    if (!uart.sending) {
        uart_begin_sending(byte, chip->cycle);
    } else {
        uart.holding = true;
        uart.held = byte;
    }
    uart_update();
}

static uint8_t uart_read_status(avr_t *chip, avr_io_addr_t address, void *nothing) {
    (void)nothing;
    uint8_t status = chip->data[address] & U2X;
    if (uart.n_received > 0) status |= RXC;
    if (!uart.sending) status |= TXC;
    if (!uart.holding) status |= UDRE;
    if (uart.overrun) status |= DOR;
    return status;
}

static void uart_write_status(avr_t *chip, avr_io_addr_t address, uint8_t value, void *nothing) {
    (void)nothing;
    chip->data[address] = value & U2X;
}

static void uart_write_control(avr_t *chip, avr_io_addr_t address, uint8_t value, void *nothing) {
    (void)nothing;
    chip->data[address] = value;
    if (!(value & RXEN)) uart.n_received = 0, uart.shift_full = false;
    uart_update();
}

static uint64_t uart_next_at(void) {
    uint64_t next = uart.sending ? uart.sent_at : NEVER;
    const bool waiting = uart.byte_begun || uart.line_begin != uart.line_end;
    if (waiting && uart.line_at < next) next = uart.line_at;
    return next;
}

static void uart_receive(uint8_t byte) {
    if (!(avr->data[UCSR0B] & RXEN)) return;
    if (uart.n_received < 2) {
        uart.received[uart.n_received++] = byte;
    } else {
        uart.shift_full = true;
        uart.shift = byte;
    }
}

static void uart_run(uint64_t now) {
    while (uart_next_at() <= now) {
        if (uart.sending && uart.sent_at <= now) {
            note(uart.sent_at, EVENT_SENT_BYTE, uart.sent_byte);
            uart.sending = false;
            if (uart.holding) {
                uart.holding = false;
                uart_begin_sending(uart.held, uart.sent_at);
            }
            continue;
        }
        if (uart.byte_begun) {
            uart.byte_begun = false;
            uart_receive(uart.line[uart.line_begin++]);
            continue;
        }
        // A start bit. A byte that still waits in the shift register is lost now.
        if (uart.shift_full) {
            uart.shift_full = false;
            uart.overrun = true;
            note(uart.line_at, EVENT_OVERRUN, uart.shift);
        }
        uart.byte_begun = true;
        uart.line_at += byte_cycles();
    }
    uart_update();
}

static void uart_put_on_line(const uint8_t *bytes, size_t n) {
    if (uart.line_begin == uart.line_end) uart.line_begin = uart.line_end = 0;
    if (uart.line_end + n > uart.line_room) {
        uart.line_room = 2 * (uart.line_end + n);
        uart.line = realloc(uart.line, uart.line_room);
        if (!uart.line) give_up("out of memory");
    }
    const bool idle = uart.line_begin == uart.line_end;
    if (idle && uart.line_at < target_cycles) uart.line_at = target_cycles;
    memcpy(uart.line + uart.line_end, bytes, n);
    uart.line_end += n;
}

static void uart_reset(void) {
    uart.n_received = 0;
    uart.shift_full = uart.overrun = uart.sending = uart.holding = false;
}

// ---- EEPROM ----

static struct {
    avr_io_write_t c;
    void *param;
} eeprom_of_simavr;

static void eeprom_write_control(avr_t *chip, avr_io_addr_t address, uint8_t value, void *nothing) {
    (void)nothing;
    enum { EEMPE = 1 << 2 };
    const bool busy = eeprom_done_at != NEVER;
    const bool writes = !busy && (chip->data[EECR] & EEMPE) && (value & EEPE);
    eeprom_of_simavr.c(chip, address, busy ? value & ~(EEPE | EEMPE) : value, eeprom_of_simavr.param);
    if (writes) eeprom_done_at = chip->cycle + EEPROM_WRITE_CYCLES;
    if (writes || busy) chip->data[EECR] |= EEPE;
}

static void eeprom_copy(uint8_t *bytes, bool into_chip) {
    avr_eeprom_desc_t whole = {.ee = bytes, .offset = 0, .size = EEPROM_BYTES};
    avr_ioctl(avr, into_chip ? AVR_IOCTL_EEPROM_SET : AVR_IOCTL_EEPROM_GET, &whole);
}

// ---- Pins ----

static char port_of(unsigned pin) { return pin < 8 ? 'D' : pin < 14 ? 'B' : 'C'; }
static unsigned bit_of(unsigned pin) { return pin < 8 ? pin : pin < 14 ? pin - 8 : pin - 14; }

static bool driven_high(unsigned pin) {
    const unsigned port = pin < 8 ? PORTD : pin < 14 ? PORTB : PORTC;
    return pin < 20 && (avr->data[port] & avr->data[port - 1]) >> bit_of(pin) & 1;
}

static void drive_input(unsigned pin, bool level) {
    if (pin >= 20) return;
    for (avr_io_t *io = avr->io_port; io; io = io->next) {
        avr_ioport_t *port = (avr_ioport_t *)io;
        if (strcmp(io->kind, "port") != 0 || port->name != port_of(pin)) continue;
        const uint8_t mask = 1 << bit_of(pin);
        port->external.pull_mask |= mask;
        port->external.pull_value = level ? port->external.pull_value | mask : port->external.pull_value & ~mask;
        avr_raise_irq(io->irq + bit_of(pin), level);
        // simavr passes on only what changes; but a reset has set its register to 0.
        avr->data[port->r_pin] = level ? avr->data[port->r_pin] | mask : avr->data[port->r_pin] & ~mask;
    }
}

static uint32_t motor_duty(void) {
    const uint8_t connected_a = 0x80, connected_b = 0x20;
    switch (pins.motor_pwm) {
    case 3: if (avr->data[TCCR2A] & connected_b) return avr->data[OCR2B]; break;
    case 5: if (avr->data[TCCR0A] & connected_b) return avr->data[OCR0B]; break;
    case 6: if (avr->data[TCCR0A] & connected_a) return avr->data[OCR0A]; break;
    case 11: if (avr->data[TCCR2A] & connected_a) return avr->data[OCR2A]; break;
    default: break;
    }
    return driven_high(pins.motor_pwm) ? 255 : 0;
}

static void note_change(uint32_t *last, uint32_t value, uint8_t kind) {
    if (*last == value) return;
    *last = value;
    note(avr->cycle, kind, value);
}

static void look_at_pins(void) {
    pins_changed = false;
    // The duty first: a duty that falls and a direction that turns in one instruction cannot be.
    note_change(&last_duty, motor_duty(), EVENT_MOTOR_DUTY);
    note_change(&last_direction, driven_high(pins.motor_direction), EVENT_DIRECTION);
    note_change(&last_reset, driven_high(pins.motor_reset), EVENT_RESET_PIN);
    const uint32_t servo = driven_high(pins.servo);
    if (servo && !last_servo) servo_rose_at = avr->cycle;
    if (!servo && last_servo) note(avr->cycle, EVENT_SERVO_PULSE, (uint32_t)(avr->cycle - servo_rose_at));
    last_servo = servo;
}

// Calls what simavr does at a register, and then remembers to look at the pins.
struct hook {
    avr_io_write_t c;
    void *param;
};

static void write_and_look(avr_t *chip, avr_io_addr_t address, uint8_t value, void *hooked) {
    const struct hook *hook = hooked;
    if (hook->c) {
        hook->c(chip, address, value, hook->param);
    } else {
        chip->data[address] = value;
    }
    pins_changed = true;
}

static void hook_pin_registers(void) {
    static const uint8_t registers[] = {DDRB,   PORTB,  DDRC,  PORTC, DDRD, PORTD,
                                        TCCR0A, TCCR2A, OCR0A, OCR0B, OCR2A, OCR2B};
    static struct hook hooks[sizeof registers];
    for (size_t i = 0; i < sizeof registers; ++i) {
        hooks[i].c = avr->io[AVR_DATA_TO_IO(registers[i])].w.c;
        hooks[i].param = avr->io[AVR_DATA_TO_IO(registers[i])].w.param;
        avr->io[AVR_DATA_TO_IO(registers[i])].w.c = write_and_look;
        avr->io[AVR_DATA_TO_IO(registers[i])].w.param = &hooks[i];
    }
}

// ---- Wheel ----

static int64_t floor_halves(int64_t position) {
    return position >= 0 ? position / HALF_EDGE : -((-position + HALF_EDGE - 1) / HALF_EDGE);
}

// Channel A turns at even half edges, channel B at odd ones; forward, A leads: after its edge the two differ.
static bool level_a(void) { return wheel.half_edges >> 1 & 1; }
static bool level_b(void) { return (wheel.half_edges - 1) >> 1 & 1; }

static void wheel_plan(void) {
    if (wheel.per_cycle == 0) {
        wheel.next_at = NEVER;
        return;
    }
    const int64_t speed = llabs(wheel.per_cycle);
    const int64_t way = wheel.per_cycle > 0 ? (wheel.half_edges + 1) * HALF_EDGE - wheel.position
                                            : wheel.position - wheel.half_edges * HALF_EDGE + 1;
    wheel.next_at = wheel.as_of + (uint64_t)((way + speed - 1) / speed);
}

static void wheel_move_to(uint64_t now) {
    wheel.position += (int64_t)(now - wheel.as_of) * wheel.per_cycle;
    wheel.as_of = now;
}

static void wheel_run(uint64_t now) {
    while (wheel.next_at <= now) {
        wheel_move_to(wheel.next_at);
        const bool a = level_a();
        wheel.half_edges = floor_halves(wheel.position);
        drive_input(pins.encoder_b, level_b());
        drive_input(pins.encoder, level_a());
        if (a != level_a()) ++wheel.edges;
        // Two edges on, all levels are the same again: so the position need not grow.
        const int64_t whole = floor_halves(wheel.position) >= 4 ? 4 : floor_halves(wheel.position) < 0 ? -4 : 0;
        wheel.position -= whole * HALF_EDGE;
        wheel.half_edges -= whole;
        wheel_plan();
    }
}

static void wheel_turn(float edges_per_s) {
    wheel_move_to(target_cycles);
    wheel.per_cycle = llround((double)edges_per_s * (double)(1 << 20));
    wheel_plan();
}

// ---- The chip ----

static void apply_inputs(void) {
    drive_input(pins.encoder_b, level_b());
    drive_input(pins.encoder, level_a());
    drive_input(pins.estop, estop_pressed == (pins.estop_pressed_level != 0));
    if (pins.battery >= 14 && pins.battery <= 21) {
        avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_ADC_GETIRQ, ADC_IRQ_ADC0 + (int)pins.battery - 14), battery_pin_mv);
    }
}

static void after_reset(void) {
    avr_extint_set_strict_lvl_trig(avr, 0, 0);
    avr_extint_set_strict_lvl_trig(avr, 1, 0);
    uart_reset();
    eeprom_done_at = NEVER;
    pass_running = false;
    crashed = false;
    apply_inputs();
    look_at_pins();
}

static void power_on(void) {
    // What RAM holds after power-on is not known; it is not zeros.
    memset(avr->data + 0x100, 0xA5, avr->ramend - 0x100 + 1);
    avr->run = run_normally;
    avr_reset(avr);
    avr->data[MCUSR] = PORF;
    after_reset();
}

static void hang(void) {
    avr->flash[TRAP_ADDRESS] = ENDLESS_LOOP & 0xFF;
    avr->flash[TRAP_ADDRESS + 1] = ENDLESS_LOOP >> 8;
    avr->pc = TRAP_ADDRESS;
    avr->sreg[S_I] = 0;
    avr->interrupt_state = 0;
}

static void count_pass(void) {
    if (pass_running && avr->cycle - pass_began_at > longest_pass) longest_pass = avr->cycle - pass_began_at;
    pass_running = true;
    pass_began_at = avr->cycle;
}

static void run_instruction(void) {
    avr->run(avr);
    if (avr->run != run_normally) {
        note(avr->cycle, EVENT_WATCHDOG, 0);
        avr->run(avr);
        after_reset();
    }
    if (avr->state == cpu_Crashed || avr->state == cpu_Done || avr->state == cpu_Stopped) {
        if (!crashed) note(avr->cycle, EVENT_CRASH, (uint32_t)avr->pc);
        crashed = true;
    }
    if (avr->pc < VECTORS_END && avr->pc > 0) avr->cycle += INTERRUPT_CYCLES;
    if (avr->pc == loop_address) count_pass();
    if (pins_changed) look_at_pins();
}

static void run_until(uint64_t end) {
    while (avr->cycle < end) {
        const uint64_t now = avr->cycle;
        wheel_run(now);
        // An interrupt of the UART that was taken leaves its cause: it must become pending again.
        uart_run(now);
        if (eeprom_done_at <= now) {
            eeprom_done_at = NEVER;
            avr->data[EECR] &= ~EEPE;
        }
        if (crashed) {
            // Time goes on without the processor.
            uint64_t next = uart_next_at() < wheel.next_at ? uart_next_at() : wheel.next_at;
            avr->cycle = next < end && next > now ? next : end;
            continue;
        }
        run_instruction();
    }
    if (pass_running && avr->cycle - pass_began_at > longest_pass) longest_pass = avr->cycle - pass_began_at;
}

// ---- Requests ----

static void read_exactly(void *bytes, size_t n) {
    if (n > 0 && fread(bytes, n, 1, stdin) != 1) give_up("a request was cut off");
}

static uint64_t read_number(unsigned bytes) {
    uint8_t raw[8];
    read_exactly(raw, bytes);
    uint64_t value = 0;
    for (unsigned i = bytes; i-- > 0;) value = value << 8 | raw[i];
    return value;
}

static void write_number(uint64_t value, unsigned bytes) {
    for (unsigned i = 0; i < bytes; ++i) putchar((int)(value >> 8 * i & 0xFF));
}

static void advance(void) {
    const uint32_t micros = (uint32_t)read_number(4);
    const uint32_t rate_bits = (uint32_t)read_number(4);
    float edges_per_s;
    memcpy(&edges_per_s, &rate_bits, sizeof edges_per_s);
    const uint32_t battery_mv = (uint32_t)read_number(2);
    const uint32_t pressed = (uint32_t)read_number(1);
    const size_t n = read_number(2);
    static uint8_t bytes[UINT16_MAX];
    read_exactly(bytes, n);
    if (!(fabsf(edges_per_s) <= 1e6f)) give_up("`encoder_edges_per_s` is %g, expected -1e6 to 1e6", (double)edges_per_s);
    if (pressed > 1) give_up("`estop_pressed` is %u, expected 0 or 1", pressed);

    estop_pressed = pressed != 0;
    battery_pin_mv = battery_mv * SUPPLY_MV / BATTERY_FULL_SCALE_MV;
    if (battery_pin_mv > SUPPLY_MV) battery_pin_mv = SUPPLY_MV;
    apply_inputs();
    wheel_turn(edges_per_s);
    uart_put_on_line(bytes, n);
    longest_pass = 0;
    target_cycles += (uint64_t)micros * CYCLES_PER_US;
    run_until(target_cycles);
    note(avr->cycle, EVENT_LONGEST_PASS, (uint32_t)longest_pass);

    putchar('a');
    write_number(avr->cycle, 8);
    write_number(wheel.edges, 4);
    write_number(n_events, 4);
    for (size_t i = 0; i < n_events; ++i) {
        write_number(events[i].cycles, 8);
        write_number(events[i].kind, 1);
        write_number(events[i].value, 4);
    }
    n_events = 0;
}

static void serve(void) {
    uint8_t eeprom[EEPROM_BYTES];
    int request;
    while ((request = getchar()) != EOF) {
        switch (request) {
        case 'A': advance(); break;
        case 'P': power_on(); putchar('p'); break;
        case 'J': hang(); putchar('j'); break;
        case 'E':
            eeprom_copy(eeprom, false);
            putchar('e');
            fwrite(eeprom, sizeof eeprom, 1, stdout);
            break;
        case 'W':
            read_exactly(eeprom, sizeof eeprom);
            eeprom_copy(eeprom, true);
            putchar('w');
            break;
        default: give_up("unknown request 0x%02x, expected A, P, J, E or W", request);
        }
        if (fflush(stdout) != 0) exit(1); // nobody listens any more
    }
}

// ---- Start ----

static uint32_t find_symbol(const char *path, const char *name) {
    uint32_t address = 0;
    bool found = false;
    const int file = open(path, O_RDONLY);
    if (file < 0) give_up("`%s`: %s", path, strerror(errno));
    elf_version(EV_CURRENT);
    Elf *elf = elf_begin(file, ELF_C_READ, NULL);
    Elf_Scn *section = NULL;
    while (elf && (section = elf_nextscn(elf, section))) {
        GElf_Shdr header;
        if (!gelf_getshdr(section, &header) || header.sh_type != SHT_SYMTAB || header.sh_entsize == 0) continue;
        Elf_Data *data = elf_getdata(section, NULL);
        for (size_t i = 0; data && i < header.sh_size / header.sh_entsize; ++i) {
            GElf_Sym symbol;
            if (!gelf_getsym(data, (int)i, &symbol)) continue;
            const char *got = elf_strptr(elf, header.sh_link, symbol.st_name);
            if (!got || strcmp(got, name) != 0) continue;
            address = (uint32_t)symbol.st_value;
            found = true;
        }
    }
    if (elf) elf_end(elf);
    close(file);
    if (!found) give_up("`%s` is no ELF file with the symbol `%s`; give `--loop-address`", path, name);
    return address;
}

static unsigned parse_number(const char *option, const char *text, unsigned long most) {
    char *end;
    errno = 0;
    const unsigned long value = strtoul(text, &end, 0);
    if (errno || end == text || *end || *text == '-' || value > most) {
        give_up("`--%s %s` is no number up to %lu", option, text, most);
    }
    return (unsigned)value;
}

static void start_chip(const char *path) {
    avr_global_logger_set(log_errors);
    elf_firmware_t firmware = {0};
    if (elf_read_firmware(path, &firmware) != 0) give_up("`%s` cannot be read as an ELF file", path);
    avr = avr_make_mcu_by_name("atmega328p");
    if (!avr || avr_init(avr) != 0) give_up("simavr knows no ATmega328P");
    avr_load_firmware(avr, &firmware);
    avr->frequency = FREQUENCY;
    avr->vcc = avr->avcc = avr->aref = SUPPLY_MV;
    run_normally = avr->run;
    for (avr_io_t *io = avr->io_port; io; io = io->next) {
        if (strcmp(io->kind, "uart") == 0) uart.simavr = (avr_uart_t *)io;
    }
    if (!uart.simavr) give_up("simavr's ATmega328P has no UART");
    avr->io[AVR_DATA_TO_IO(UDR0)].r.c = uart_read_data;
    avr->io[AVR_DATA_TO_IO(UDR0)].w.c = uart_write_data;
    avr->io[AVR_DATA_TO_IO(UCSR0A)].r.c = uart_read_status;
    avr->io[AVR_DATA_TO_IO(UCSR0A)].w.c = uart_write_status;
    avr->io[AVR_DATA_TO_IO(UCSR0B)].w.c = uart_write_control;
    eeprom_of_simavr.c = avr->io[AVR_DATA_TO_IO(EECR)].w.c;
    eeprom_of_simavr.param = avr->io[AVR_DATA_TO_IO(EECR)].w.param;
    avr->io[AVR_DATA_TO_IO(EECR)].w.c = eeprom_write_control;
    hook_pin_registers();
    wheel.position = 2 * HALF_EDGE;
    wheel.half_edges = 2;
    wheel.next_at = NEVER;
    power_on();
}

int main(int argc, char **argv) {
    static const struct option options[] = {
        {"elf", required_argument, NULL, 'f'},
        {"loop-address", required_argument, NULL, 'l'},
        {"servo-pin", required_argument, NULL, 0},
        {"motor-pwm-pin", required_argument, NULL, 1},
        {"motor-direction-pin", required_argument, NULL, 2},
        {"motor-reset-pin", required_argument, NULL, 3},
        {"encoder-pin", required_argument, NULL, 4},
        {"encoder-b-pin", required_argument, NULL, 5},
        {"estop-pin", required_argument, NULL, 6},
        {"estop-pressed-level", required_argument, NULL, 7},
        {"battery-pin", required_argument, NULL, 8},
        {NULL, 0, NULL, 0},
    };
    unsigned *const numbers[] = {&pins.servo,     &pins.motor_pwm, &pins.motor_direction,     &pins.motor_reset, &pins.encoder,
                                 &pins.encoder_b, &pins.estop,     &pins.estop_pressed_level, &pins.battery};
    const char *path = NULL;
    const char *address = NULL;
    int option, index = 0;
    while ((option = getopt_long(argc, argv, "", options, &index)) != -1) {
        if (option == 'f') path = optarg;
        else if (option == 'l') address = optarg;
        else if (option >= 0 && option <= 8) *numbers[option] = parse_number(options[index].name, optarg, 255);
        else return 2;
    }
    if (!path || optind != argc) {
        fputs("usage: simulated-chip --elf FILE [--loop-address ADDRESS] [--servo-pin 9] [--motor-pwm-pin 11]\n"
              "    [--motor-direction-pin 4] [--motor-reset-pin 7] [--encoder-pin 2] [--encoder-b-pin 255]\n"
              "    [--estop-pin 8] [--estop-pressed-level 0] [--battery-pin 14]\n", stderr);
        return 2;
    }
    loop_address = address ? parse_number("loop-address", address, 0x7FFE) : find_symbol(path, LOOP_SYMBOL);
    start_chip(path);
    serve();
    return 0;
}
