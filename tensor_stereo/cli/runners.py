import sys


def run(c):
    print(c)
