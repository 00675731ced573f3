// SPDX-License-Identifier: Apache-2.0


/* Samples an analog accelerometer by a 16 bit SPI ADC and sends it to the driver of adxl_ros,
 * link.type serial.
 *
 * Board: any Teensy, or an Arduino with an ATmega328P, 32U4 or 2560. ADC: ADS8344 at 5 V, CS on
 * pin 10. CH0 is x, CH1 is y, CH2 is the sensor's supply through a 2:1 divider. The driver needs
 * link.channels:=x,y,supply link.supply_scale:=2.0. For another ADC change read_adc() and the
 * constants of the ADC.
 *
 * A timer takes the samples, and the loop sends them in blocks. A command of the host sets how many
 * samples make a block, at most ten. Blocks grow to ten while others wait, so a slow wire gets
 * longer frames. When the host does not read, blocks are dropped and their samples are counted. So
 * the driver knows exactly how many samples are missing.
 *
 * Another command switches the self-test of the sensor on. The timer switches it off, whatever the
 * host and the port do, and marks the samples that it has changed. */

#include <SPI.h>

#include "frame.h"

const char SERIAL_NUMBER[] = "adxl-0001"; /* of the sensor on this board, at most 16 characters */
const float RATE_HZ = 1000.0f;            /* sample rate, Hz */
const long BAUD = 500000;                 /* baud rate; USB boards ignore it */

const uint8_t CHANNELS = 3; /* channels of the ADC that are read */
const uint8_t BITS = 16;    /* resolution of the ADC, bit */
const float VREF_V = 5.0f;  /* reference voltage of the ADC, V */
const uint8_t CS_PIN = 10;  /* chip select of the ADC */
const SPISettings ADC_BUS(2000000, MSBFIRST, SPI_MODE0); /* the ADS8344 permits 2.4 MHz */

#ifndef ST_PIN
#define ST_PIN -1 /* pin of the board at the ST pin of the sensor; -1: not connected */
#endif
const float SETTLING_S = 0.2f;    /* after a self-test samples are marked for, s; >= 20 R*C */
const float MAX_SELF_TEST_S = 5.0f; /* longest time of a self-test without a new command, s */

const uint8_t BLOCK = 10; /* most samples of a block, and those before the first command */
const uint8_t BLOCKS = 8; /* blocks that wait for the host; 80 ms of samples */

struct block {
    uint64_t t_us;
    uint32_t first_index;
    uint16_t overruns;
    uint8_t samples;
    uint8_t flags;
    uint16_t codes[BLOCK * CHANNELS];
};

/* The timer writes blocks[made % BLOCKS], the loop sends blocks[sent % BLOCKS]. */
static struct block blocks[BLOCKS];
static volatile uint8_t made, sent;
static volatile uint8_t wanted = BLOCK; /* samples of a block while no other one waits */
static volatile uint32_t in_self_test; /* samples to come that are marked; ST is on for the first */
static struct frame_counts counts = {0, FRAME_AFTER_RESET};
static uint8_t frame[FRAME_ROOM(BLOCK, CHANNELS)];

static uint16_t read_adc(uint8_t channel) {
    /* Control byte: start, channel, single ended, always on. After one busy clock come 16 bits. */
    const uint8_t select = (uint8_t)(((channel & 1) << 2) | (channel >> 1));
    uint32_t raw;
    digitalWrite(CS_PIN, LOW);
    SPI.transfer(0x87 | (select << 4));
    raw = (uint32_t)SPI.transfer(0) << 16;
    raw |= (uint32_t)SPI.transfer(0) << 8;
    raw |= SPI.transfer(0);
    digitalWrite(CS_PIN, HIGH);
    return (uint16_t)(raw >> 7);
}

/* micros() wraps after 71 minutes; the device clock does not. */
static uint64_t now_us() {
    static uint32_t last = 0, wraps = 0;
    const uint32_t us = micros();
    wraps += us < last;
    last = us;
    return ((uint64_t)wraps << 32) | us;
}

/* Count a sample; return its flags. */
static uint8_t count_self_test() {
    if (!in_self_test) {
        return 0;
    }
    if (--in_self_test == (uint32_t)(SETTLING_S * RATE_HZ)) {
        digitalWrite(ST_PIN, LOW);
    }
    return FRAME_IN_SELF_TEST;
}

static void take_sample() {
    static uint32_t index = 0;
    static uint16_t overruns = 0;
    static uint8_t filled = 0;
    const uint64_t t_us = now_us();
    const uint8_t flags = ST_PIN < 0 ? 0 : count_self_test();
    struct block *b = &blocks[made % BLOCKS];
    if (!filled && (uint8_t)(made - sent) == BLOCKS) { /* all blocks wait for the host */
        index++;
        overruns++;
        return;
    }
    if (!filled) {
        b->t_us = t_us;
        b->first_index = index;
        b->overruns = overruns;
        b->flags = 0;
    }
    b->flags |= flags;
    SPI.beginTransaction(ADC_BUS);
    for (uint8_t c = 0; c < CHANNELS; c++) {
        b->codes[filled * CHANNELS + c] = read_adc(c);
    }
    SPI.endTransaction();
    index++;
    if (++filled == BLOCK || (filled >= wanted && made == sent)) {
        b->samples = filled;
        filled = 0;
        made++;
    }
}

#if defined(TEENSYDUINO)
static IntervalTimer timer;
static void start_timer() { timer.begin(take_sample, 1e6f / RATE_HZ); }
#elif defined(__AVR__)
ISR(TIMER1_COMPA_vect) { take_sample(); }
static void start_timer() {
    noInterrupts();
    TCCR1A = 0;
    TCCR1B = _BV(WGM12) | _BV(CS11); /* clear on compare, clock / 8 */
    TCNT1 = 0;
    OCR1A = (uint16_t)(F_CPU / 8 / RATE_HZ) - 1;
    TIMSK1 = _BV(OCIE1A);
    interrupts();
}
#else
#error "No timer for this board: add one that calls take_sample() RATE_HZ times a second"
#endif

/* Switch the self-test on for a time from now; 0 ends it. */
static void hold_self_test(uint32_t time_us) {
    const uint32_t settling = (uint32_t)(SETTLING_S * RATE_HZ);
    float time_s = (float)time_us * 1e-6f;
    uint32_t samples;
    if (ST_PIN < 0) {
        return;
    }
    time_s = time_s < MAX_SELF_TEST_S ? time_s : MAX_SELF_TEST_S;
    samples = (uint32_t)(time_s * RATE_HZ);
    noInterrupts();
    if (samples) {
        in_self_test = samples + settling;
    } else if (in_self_test > settling) {
        in_self_test = settling;
    }
    digitalWrite(ST_PIN, samples ? HIGH : LOW);
    interrupts();
}

void setup() {
    if (ST_PIN >= 0) {
        pinMode(ST_PIN, OUTPUT);
        digitalWrite(ST_PIN, LOW);
    }
    pinMode(CS_PIN, OUTPUT);
    digitalWrite(CS_PIN, HIGH);
    SPI.begin();
    Serial.begin(BAUD);
    start_timer();
}

static void send(size_t length) {
    /* Waits for room in the port; the timer goes on meanwhile. */
    Serial.write(frame, length);
#if defined(TEENSYDUINO)
    Serial.send_now(); /* or USB waits for more bytes */
#endif
}

/* Take the commands of the host; return whether there was one. */
static bool receive() {
    static struct frame_receiver receiver;
    bool commanded = false;
    while (Serial.available() > 0) {
        uint32_t time_us;
        const int command = frame_command(&receiver, (uint8_t)Serial.read(), &time_us);
        if (command == FRAME_LATENCY) {
            wanted = frame_samples(time_us, RATE_HZ, BLOCK);
        } else if (command == FRAME_SELF_TEST) {
            hold_self_test(time_us);
        }
        commanded |= command != 0;
    }
    return commanded;
}

void loop() {
    static uint32_t informed_ms = 0;
    static bool informed = false;
    if (!Serial) { /* no host has opened the port: dropped samples are counted */
        return;
    }
    if (receive()) {
        informed = false; /* the info frame is the answer */
    }
    if (!informed || millis() - informed_ms >= 1000) {
        counts.flags |= ST_PIN < 0 ? 0 : FRAME_HAS_SELF_TEST;
        send(frame_info(&counts, RATE_HZ, BITS, CHANNELS, VREF_V, SERIAL_NUMBER, frame));
        informed_ms = millis();
        informed = true;
    }
    if (made != sent) {
        const struct block *b = &blocks[sent % BLOCKS];
        counts.flags |= b->flags;
        send(frame_data(&counts, b->t_us, b->first_index, b->overruns, b->samples, CHANNELS,
                        b->codes, BITS, frame));
        sent++;
    }
}
