"""The noise generator once more, in plain Python integers, one number at a time: slow and obvious."""

M32, M64 = 2**32 - 1, 2**64 - 1
GOLDEN = 0x9E3779B97F4A7C15


def mix64(x: int) -> int:
    x = ((x ^ (x >> 30)) * 0xBF58476D1CE4E5B9) & M64
    x = ((x ^ (x >> 27)) * 0x94D049BB133111EB) & M64
    return x ^ (x >> 31)


def stream_key(*fields: int) -> list[int]:
    state = 0
    for field in fields:
        state = mix64(((state ^ field) + GOLDEN) & M64)
    words = []
    for i in (1, 2):
        half = mix64((state + GOLDEN * i) & M64)
        words += [half & M32, half >> 32]
    return words


def hash_words(key: list[int], coordinate: int) -> tuple[int, int]:
    x = (coordinate * 0x9E3779B9 + key[0]) & M32
    x = (((x ^ (x >> 16)) * 0x21F0AAAD) & M32) ^ key[1]
    x = ((x ^ (x >> 15)) * 0xD35A2D97) & M32
    x ^= x >> 15
    y = ((x + key[2]) * 0x85EBCA6B) & M32
    y = (((y ^ (y >> 15)) * 0xC2B2AE35) & M32) ^ key[3]
    y = ((y ^ (y >> 16)) * 0x21F0AAAD) & M32
    return x, y ^ (y >> 15)


def normal_integer(key: list[int], coordinate: int) -> int:
    x, y = hash_words(key, coordinate)
    ones = bin(x).count("1") + bin(y >> 2).count("1")
    return 8 * ones + 2 * (y & 3) - 251


def uniform(key: list[int], coordinate: int) -> float:
    return (hash_words(key, coordinate)[1] >> 8) / 2**24
