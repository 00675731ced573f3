// SPDX-License-Identifier: Apache-2.0

#include "frame.h"

#include <string.h>

/* Computes the CRC and COBS byte by byte, so no second buffer is needed. */
struct writer {
    uint8_t *out;  /* begin of the frame */
    size_t code;   /* index of the length of the present COBS run */
    size_t next;   /* index of the next byte */
    uint32_t crc;  /* CRC-32 so far, as zlib computes it, before the final inversion */
};

static void stuff(struct writer *w, uint8_t byte) {
    if (byte) {
        w->out[w->next++] = byte;
    }
    if (!byte || w->next - w->code == 255) {
        w->out[w->code] = (uint8_t)(w->next - w->code);
        w->code = w->next++;
    }
}

static uint32_t crc_step(uint32_t crc, uint8_t byte) {
    int bit;
    crc ^= byte;
    for (bit = 0; bit < 8; bit++) {
        crc = (crc >> 1) ^ ((crc & 1) ? 0xEDB88320u : 0);
    }
    return crc;
}

static void put(struct writer *w, uint8_t byte) {
    w->crc = crc_step(w->crc, byte);
    stuff(w, byte);
}

static void put_number(struct writer *w, uint64_t value, int bytes) {
    while (bytes--) {
        put(w, (uint8_t)value);
        value >>= 8;
    }
}

static void put_float(struct writer *w, float value) {
    uint32_t raw;
    memcpy(&raw, &value, sizeof raw);
    put_number(w, raw, 4);
}

static void begin(struct writer *w, struct frame_counts *counts, uint8_t type, uint16_t flags,
                  uint8_t *out) {
    w->out = out;
    w->code = 0;
    w->next = 1;
    w->crc = 0xFFFFFFFFu;
    put(w, type);
    put(w, 1); /* version */
    put_number(w, flags, 2);
    put_number(w, counts->block_seq++, 4);
}

static size_t end(struct writer *w) {
    uint32_t crc = ~w->crc;
    int i;
    for (i = 0; i < 4; i++) {
        stuff(w, (uint8_t)(crc >> (8 * i)));
    }
    w->out[w->code] = (uint8_t)(w->next - w->code);
    w->out[w->next++] = 0;
    return w->next;
}

size_t frame_data(struct frame_counts *counts, uint64_t t_dev_us, uint32_t first_index,
                  uint16_t overruns, uint8_t nsamp, uint8_t nch, const uint16_t *codes,
                  uint8_t bits, uint8_t *out) {
    struct writer w;
    uint16_t flags = counts->flags;
    size_t i, count = (size_t)nsamp * nch;
    for (i = 0; i < count; i++) {
        if (codes[i] == 0 || codes[i] >= (1uL << bits) - 1) {
            flags |= FRAME_RAIL;
        }
    }
    begin(&w, counts, 1, flags, out);
    counts->flags = 0;
    put_number(&w, t_dev_us, 8);
    put_number(&w, first_index, 4);
    put_number(&w, overruns, 2);
    put(&w, nsamp);
    put(&w, nch);
    for (i = 0; i < count; i++) {
        put_number(&w, codes[i], 2);
    }
    return end(&w);
}

size_t frame_info(struct frame_counts *counts, float rate_hz, uint8_t bits, uint8_t nch,
                  float vref_v, const char *serial, uint8_t *out) {
    struct writer w;
    int i, ended = 0;
    begin(&w, counts, 2, counts->flags, out);
    put_float(&w, rate_hz);
    put(&w, bits);
    put(&w, nch);
    put_float(&w, vref_v);
    for (i = 0; i < 16; i++) {
        ended = ended || !serial[i];
        put(&w, ended ? 0 : (uint8_t)serial[i]);
    }
    return end(&w);
}

static uint32_t number(const uint8_t *raw) {
    return raw[0] | (uint32_t)raw[1] << 8 | (uint32_t)raw[2] << 16 | (uint32_t)raw[3] << 24;
}

/* Undo COBS in place; return the length of what remains, 0 if it is not valid. */
static uint8_t unstuff(uint8_t *raw, uint8_t length) {
    uint8_t next = 0, made = 0;
    while (next < length) {
        const uint8_t code = raw[next++];
        uint8_t i;
        if (next + code - 1 > length) {
            return 0;
        }
        for (i = 1; i < code; i++) {
            raw[made++] = raw[next++];
        }
        if (next < length) {
            raw[made++] = 0; /* no run of a command is so long that it ends without a 0 */
        }
    }
    return made;
}

int frame_command(struct frame_receiver *receiver, uint8_t byte, uint32_t *time_us) {
    uint8_t *raw = receiver->raw;
    uint8_t i, length = receiver->length;
    uint32_t crc = 0xFFFFFFFFu;
    if (byte) {
        if (length < FRAME_COMMAND_ROOM) {
            raw[length] = byte;
        }
        receiver->length = length > FRAME_COMMAND_ROOM ? length : (uint8_t)(length + 1);
        return 0;
    }
    receiver->length = 0;
    if (length != FRAME_COMMAND_ROOM || unstuff(raw, length) != FRAME_COMMAND_ROOM - 1) {
        return 0;
    }
    for (i = 0; i < FRAME_COMMAND_ROOM - 5; i++) {
        crc = crc_step(crc, raw[i]);
    }
    if (~crc != number(raw + FRAME_COMMAND_ROOM - 5) || raw[1] != 1 ||
        (raw[0] != FRAME_LATENCY && raw[0] != FRAME_SELF_TEST)) {
        return 0;
    }
    *time_us = number(raw + 8);
    return raw[0];
}

uint8_t frame_samples(uint32_t latency_us, float rate_hz, uint8_t most) {
    /* A product such as 2000 us * 1000 Hz may lack the last bit of a whole number. */
    const float samples = (float)latency_us * 1e-6f * rate_hz + 1e-3f;
    if (samples >= most) {
        return most;
    }
    return samples < 1 ? 1 : (uint8_t)samples;
}
