// SPDX-License-Identifier: Apache-2.0

/* What the sketch needs of an Arduino, on this machine, for the tests of the firmware.
 *
 * The program gets the open file of a terminal and the baud rate of its UART, 0 for USB. A thread is
 * the timer; in it the time is that for which it was set, because an interrupt is not late where a
 * thread of a busy machine is. Channel c has the code (k + 20000 c) mod 65534 + 1 at sample k, and
 * during the self-test the code of 7000 samples later. */

#include <poll.h>
#include <stdint.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

#include <chrono>
#include <mutex>
#include <thread>

#define TEENSYDUINO 1
enum { OUTPUT, HIGH, LOW, MSBFIRST, SPI_MODE0 };
static void pinMode(int, int) {}
static volatile uint32_t step; /* of the codes, by the self-test */
static void digitalWrite(int pin, int level) {
    if (pin == ST_PIN) {
        step = level == HIGH ? 7000 : 0;
    }
}
static std::recursive_mutex interrupt;
static void noInterrupts() { interrupt.lock(); }
static void interrupts() { interrupt.unlock(); }

static uint64_t host_us() {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000u + now.tv_nsec / 1000u;
}
static thread_local uint64_t interrupt_us; /* 0 outside of the timer */
static uint32_t micros() { return (uint32_t)(interrupt_us ? interrupt_us : host_us()); }
static uint32_t millis() { return (uint32_t)(host_us() / 1000u); }

struct SPISettings {
    SPISettings(uint32_t, int, int) {}
};

/* An ADS8344: a control byte, then 16 bits after one busy clock. */
static struct {
    uint32_t conversions, shifted;
    void begin() {}
    void beginTransaction(const SPISettings &) {}
    void endTransaction() {}
    uint8_t transfer(uint8_t control) {
        const uint8_t out = (uint8_t)(shifted >> 16);
        shifted <<= 8;
        if (control & 0x80) {
            const uint8_t channel = (uint8_t)((control >> 6 & 1) | (control >> 4 & 3) << 1);
            const uint32_t sample = conversions++ / 3 + step;
            shifted = ((sample + 20000u * channel) % 65534u + 1u) << 7;
        }
        return out;
    }
} SPI;

struct IntervalTimer {
    void begin(void (*call)(), float period_us) {
        std::thread([=] {
            auto due = std::chrono::steady_clock::now();
            for (;;) {
                due += std::chrono::nanoseconds((int64_t)(period_us * 1e3f));
                std::this_thread::sleep_until(due);
                interrupt_us = (uint64_t)std::chrono::duration_cast<std::chrono::microseconds>(
                    due.time_since_epoch()).count();
                noInterrupts();
                call();
                interrupts();
            }
        }).detach();
    }
};

static struct {
    int fd;
    uint32_t baud;
    uint64_t idle_us; /* when the UART has sent what it was given */
    void begin(long) {}
    explicit operator bool() { return true; }
    int available() {
        struct pollfd waiting = {fd, POLLIN, 0};
        return poll(&waiting, 1, 0) > 0 && waiting.revents & POLLIN;
    }
    int read() {
        uint8_t byte = 0;
        return ::read(fd, &byte, 1) == 1 ? byte : -1;
    }
    void write(const uint8_t *raw, size_t length) {
        if (baud) {
            const uint64_t now_us = host_us();
            idle_us = (idle_us > now_us ? idle_us : now_us) + length * 10000000u / baud;
            usleep((useconds_t)(idle_us - now_us));
        }
        if (::write(fd, raw, length) != (ssize_t)length) {
            exit(1);
        }
    }
    void send_now() {}
} Serial;

void setup();
void loop();

int main(int, char **argv) {
    Serial.fd = atoi(argv[1]);
    Serial.baud = (uint32_t)atoi(argv[2]);
    setup();
    for (;;) {
        loop();
        usleep(50);
    }
}
