#define OPENPATCH_IMPLEMENTATION
#include "openpatch.h"

// What the patch is. Physical value = offset + scale * raw, here from -20 to 80 degC.
const openpatch_type types[] = {
    // id, scale, offset, minimum, maximum, name, unit
    {1, 0.1f, 0.0f, 0.0f, 102.3f, "pressure", "kPa"},
    {5, 0.25f, -20.0f, -20.0f, 80.0f, "temperature", "degC"},
};
const openpatch_run runs[] = {{4, 1, {0}}, {1, 1, {1}}};  // 4 taxels of type 0, then 1 of type 1
const openpatch_kind kinds[] = {{OPENPATCH_U16, OPENPATCH_TABLE(runs), "fingertip"}};
openpatch_module modules[] = {OPENPATCH_MODULE(0)};  // one module, of kind 0

// What the header needs of the board.
int read_byte() { return Serial.read(); }  // -1: there is none
void write_bytes(const uint8_t *bytes, size_t n) { Serial.write(bytes, n); }
uint32_t now_us() { return micros(); }

const openpatch_description description = {
    10000, 2000, 1000000,             // period at first, shortest, longest, in microseconds
    "my fingertip", "0001", "1.0.0",  // product, serial number, firmware
    OPENPATCH_TABLE(types), OPENPATCH_TABLE(kinds), OPENPATCH_TABLE(modules),
    read_byte, write_bytes, now_us, NULL, NULL, NULL,  // the last three are optional (see below)
};

openpatch patch;
uint32_t due_us;

void setup() {
    Serial.begin(115200);
    openpatch_init(&patch, &description, OPENPATCH_RESET_UNKNOWN);
    due_us = micros();
}

void loop() {
    openpatch_poll(&patch);

    if ((int32_t)(micros() - due_us) < 0) return;
    due_us += patch.period_us;
    if ((int32_t)(micros() - due_us) > 0) due_us = micros();  // late: nothing is made up for

    const uint32_t sampled_us = micros();
    uint16_t values[5];
    for (uint8_t i = 0; i < 5; i++) values[i] = (uint16_t)analogRead(i);
    openpatch_send(&patch, 0, sampled_us, values, 0, NULL);
}
