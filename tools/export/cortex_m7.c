/* What a Cortex-M7 does before main, under QEMU: the floating-point unit is switched on, then newlib starts. */
#include <stdint.h>

extern void _start(void);
extern uint32_t __stack;
void reset(void);

void reset(void)
{
    *(volatile uint32_t *)0xE000ED88u |= 0xFu << 20; /* CPACR: full access to coprocessors 10 and 11 */
    __asm__ volatile("dsb\n isb");
    _start();
}

static void fault(void)
{
    for (;;) {
    }
}

__attribute__((section(".vectors"), used)) static const struct {
    uint32_t *stack;
    void (*handlers[6])(void);
} vectors = {&__stack, {reset, fault, fault, fault, fault, fault}};
