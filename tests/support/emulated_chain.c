/* Harness of chain on a Cortex-M4F: start-up, self-test, count of instructions, results by semihosting. */
#include "chain.h"

extern int32_t chain_selftest(void);
extern uint32_t stack_top;
void start(void);
void *memcpy(void *to, const void *from, uint32_t n);
void *memset(void *to, int value, uint32_t n);

#define SYSTICK ((volatile uint32_t *)0xE000E010U)
#define CPACR (*(volatile uint32_t *)0xE000ED88U)
#define SAMPLES 4000

__attribute__((section(".vectors"), used)) static const uint32_t *const vectors[2] = { &stack_top, (const uint32_t *)start };

void *memcpy(void *to, const void *from, uint32_t n)
{
    unsigned char *a = to;
    const unsigned char *b = from;
    while (n--) { *a++ = *b++; }
    return to;
}

void *memset(void *to, int value, uint32_t n)
{
    unsigned char *a = to;
    while (n--) { *a++ = (unsigned char)value; }
    return to;
}

static uint32_t semihost(uint32_t operation, const void *argument)
{
    register uint32_t r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = argument;
    __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

static void print(const char *text) { (void)semihost(4U, text); }

static void print_number(const char *name, uint32_t value)
{
    char text[12];
    int i = 11;
    text[i] = 0;
    do { text[--i] = (char)('0' + (value % 10U)); value /= 10U; } while (value != 0U);
    print(name);
    print(" ");
    print(text + i);
    print("\n");
}

__attribute__((noinline)) static void nothing(chain_state *state, const chain_input *in, chain_output *out)
{
    __asm__ volatile("" : : "r"(state), "r"(in), "r"(out) : "memory");
}

/* Ticks of SysTick for SAMPLES samples. kind: 0 usual, 1 faulty, 2 saturated */
static uint32_t ticks(void (*step)(chain_state *, const chain_input *, chain_output *), int kind)
{
    static chain_state state;
    volatile chain_real zero = (chain_real)0.0;
    chain_output out;
    chain_input in;
    uint32_t first;
    int k;
    chain_init(&state);
    in.position[0] = (kind == 1) ? (zero / zero) : (chain_real)1e-6;
    in.position[1] = (chain_real)1e-6;
    in.angle = (chain_real)1.0;
    in.pressure_bar = (chain_real)PRESSURE_BAR;
    in.speed_rpm = (chain_real)SPEED_RPM;
    in.mode = 2;
    first = SYSTICK[2];
    for (k = 0; k < SAMPLES; k++) {
        in.angle = ((k & 1) != 0) ? (chain_real)1.0 : (chain_real)5.0;
        if (kind == 2) { in.position[1] = ((k & 4) != 0) ? (chain_real)1e-3 : -(chain_real)1e-3; }
        step(&state, &in, &out);
    }
    return (first - SYSTICK[2]) & 0xFFFFFFU;
}

void start(void)
{
    static const uint32_t done[1] = { 0x20026U };
    extern unsigned char data_from[], data_to[], data_end[], bss_end[];
    CPACR |= 0xF00000U; /* floating-point unit on */
    __asm__ volatile("dsb\n\tisb");
    (void)memcpy(data_to, data_from, (uint32_t)(data_end - data_to));
    (void)memset(data_end, 0, (uint32_t)(bss_end - data_end));
    SYSTICK[1] = 0xFFFFFFU;
    SYSTICK[2] = 0U;
    SYSTICK[0] = 5U;
    print_number("selftest", (uint32_t)chain_selftest());
    print_number("state", (uint32_t)sizeof(chain_state));
    print_number("loop", ticks(nothing, 0));
    print_number("usual", ticks(chain_step, 0));
    print_number("faulty", ticks(chain_step, 1));
    print_number("saturated", ticks(chain_step, 2));
    (void)semihost(0x18U, (const void *)(uintptr_t)done[0]);
    for (;;) { }
}
