/* Calls the function `kernel` that it is linked with, once, on memory that it reads from standard input, and writes this
 * memory to standard output. It is linked with no library, so a kernel that calls one does not link either.
 *
 * Input, in 64-bit words: numbers of segments, addresses, integers and floats; the size of each segment in bytes; for
 * each address (segment, byte, segment whose address is put there); for each integer (whether it is a segment whose
 * address is meant, value); the bits of each float. Then the segments' bytes. Output: the segments' bytes.
 */
typedef unsigned long word;

void kernel(word, word, word, word, word, word, word, word, word, word, word, word, float, float);

enum { READ = 63, WRITE = 64, EXIT = 93, MMAP = 222 };
enum { ROUND_UP = 1 << 22 }; /* a mode of FPCR that no kernel uses */

static long system_call(long number, long a, long b, long c, long d, long e, long f)
{
    register long x8 __asm__("x8") = number, x0 __asm__("x0") = a, x1 __asm__("x1") = b, x2 __asm__("x2") = c;
    register long x3 __asm__("x3") = d, x4 __asm__("x4") = e, x5 __asm__("x5") = f;
    __asm__ volatile("svc 0" : "+r"(x0) : "r"(x8), "r"(x1), "r"(x2), "r"(x3), "r"(x4), "r"(x5) : "memory");
    return x0;
}

static void stop(long status)
{
    for (;;)
        system_call(EXIT, status, 0, 0, 0, 0, 0);
}

static void transfer(long number, void *at, word size)
{
    while (size) {
        long done = system_call(number, number == WRITE, (long)at, size, 0, 0, 0);
        if (done <= 0)
            stop(1);
        at = (char *)at + done;
        size -= done;
    }
}

static void *memory(word size) /* zeros, at the start of a page */
{
    long found = system_call(MMAP, 0, size + 1, 3, 0x22, -1, 0);
    if (found < 0)
        stop(2);
    return (void *)found;
}

static word *words(word count)
{
    word *found = memory(8 * count);
    transfer(READ, found, 8 * count);
    return found;
}

void _start(void)
{
    word *count = words(4), *size = words(count[0]), *address = words(3 * count[1]), *integer = words(2 * count[2]);
    word *bits = words(count[3]), argument[12] = {0}, before = ROUND_UP, after;
    char **segment = memory(8 * count[0]);
    float number[2] = {0};
    for (word k = 0; k < count[0]; k++) {
        segment[k] = memory(size[k]);
        transfer(READ, segment[k], size[k]);
    }
    for (word k = 0; k < count[1]; k++)
        *(char **)(segment[address[3 * k]] + address[3 * k + 1]) = segment[address[3 * k + 2]];
    for (word k = 0; k < count[2]; k++)
        argument[k] = integer[2 * k] ? (word)segment[integer[2 * k + 1]] : integer[2 * k + 1];
    for (word k = 0; k < count[3]; k++)
        number[k] = *(float *)(bits + k);

    __asm__ volatile("msr fpcr, %0" : : "r"(before) : "memory");
    /* Integers and floats are numbered separately, so their order among each other makes no difference. */
    kernel(argument[0], argument[1], argument[2], argument[3], argument[4], argument[5], argument[6], argument[7],
           argument[8], argument[9], argument[10], argument[11], number[0], number[1]);
    __asm__ volatile("mrs %0, fpcr" : "=r"(after) : : "memory");
    if (after != before)
        stop(3);
    for (word k = 0; k < count[0]; k++)
        transfer(WRITE, segment[k], size[k]);
    stop(0);
}
