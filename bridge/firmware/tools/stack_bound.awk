# An upper bound of the stack from the disassembly of the linked firmware (avr-objdump -d): the deepest chain of calls from
# main, and on it the deepest interrupt; interrupts do not nest (none turns interrupts on again).
#
# Each function counts what it pushes, the frame that it takes from the stack pointer, and two bytes of return address per call.
# A jump to another function, and running on into it, count as part of the function. Gives up on recursion, on frames of variable size, and on indirect calls other
# than to the functions named in `indirect` (a comma between two), which then count as called from wherever one is.
#
# Prints three numbers: main with all it calls, the deepest interrupt, and their sum.

BEGIN { level = 0 }

function hex(text,    i, value) {
    for (i = 3; i <= length(text); i++) value = 16 * value + index("123456789abcdef", tolower(substr(text, i, 1)))
    return value + 0
}

function give_up(reason) { print "stack_bound: " reason > "/dev/stderr"; failed = 1; exit 1 }

/^[0-9a-f]+ <.*>:$/ {
    name = $2
    gsub(/[<>:]/, "", name)
    if (runs_on) jumps[previous] = jumps[previous] " " name
    previous = name
    own[name] += 0
    low_byte = -1
    next
}
name == "" || NF < 2 { next }
{
    # Address, bytes of the instruction, mnemonic, operands; apart by tabs.
    split($0, columns, "\t")
    mnemonic = columns[3]
    operands = columns[4]
    target = ""
    if (match($0, /<[^>+]+(\+0x[0-9a-f]+)?>/)) target = substr($0, RSTART + 1, RLENGTH - 2)
    sub(/\+0x.*/, "", target)
    runs_on = mnemonic !~ /^(reti?|r?jmp|e?ijmp)$/
}
mnemonic == "push" { own[name]++ }
# `rcall .+0` only takes two bytes from the stack.
mnemonic == "rcall" && operands ~ /^\.\+0/ { own[name] += 2; next }
mnemonic ~ /^r?call$/ { calls[name] = calls[name] " " target; next }
mnemonic ~ /^(r?jmp|br..)$/ && target != "" && target != name { jumps[name] = jumps[name] " " target }
mnemonic ~ /^e?i(call|jmp)$/ { calls[name] = calls[name] " *" }
mnemonic == "sei" && name ~ /^__vector_/ { give_up(name " turns interrupts on: they could nest") }
# A frame: Y is the stack pointer less the frame's size, and goes back to the stack pointer.
mnemonic == "in" && operands ~ /^r28, 0x3d/ { frame = 0 }
mnemonic == "sbiw" && operands ~ /^r28/ { split(operands, parts, /[ ,;]+/); frame = hex(parts[2]) }
mnemonic == "subi" && operands ~ /^r28/ { split(operands, parts, /[ ,;]+/); low_byte = hex(parts[2]) }
mnemonic == "sbc" && operands ~ /^r29, r1/ && low_byte >= 0 { frame = low_byte; low_byte = -1 }
mnemonic == "sbci" && operands ~ /^r29/ && low_byte >= 0 {
    split(operands, parts, /[ ,;]+/)
    frame = hex(parts[2]) * 256 + low_byte
    # Adding is subtracting the complement: the frame is given back.
    if (frame >= 32768) frame = 0
    low_byte = -1
}
mnemonic == "adiw" && operands ~ /^r28/ { frame = 0 }
mnemonic == "out" && operands ~ /^0x3d, r28/ {
    if (frame > largest[name]) largest[name] = frame
    frame = 0
}
mnemonic == "out" && operands ~ /^0x3d/ && operands !~ /r28/ && name != "__init" && name !~ /^__(ctors|bad|vectors|trampolines)/ {
    give_up(name " sets the stack pointer in a way that is not known here")
}

function depth(f,    i, n, list, deepest, d) {
    if (f in known) return known[f]
    if (f in busy) {
        # A loop of jumps does not take more of the stack with each turn.
        if (busy[f] == level) return 0
        give_up("recursion through " f)
    }
    busy[f] = level
    deepest = 0
    n = split(jumps[f], list, " ")
    for (i = 1; i <= n; i++) {
        d = depth(list[i])
        if (d > deepest) deepest = d
    }
    level++
    n = split(calls[f], list, " ")
    for (i = 1; i <= n; i++) {
        d = 2 + (list[i] == "*" ? indirect_depth(f) : depth(list[i]))
        if (d > deepest) deepest = d
    }
    level--
    delete busy[f]
    d = own[f] + largest[f] + deepest
    # Within a loop of jumps the others of the loop are not known yet.
    if (jumps[f] == "") known[f] = d
    return d
}

function indirect_depth(f,    i, n, list, g, d, deepest) {
    n = split(indirect, list, ",")
    if (n == 0) give_up("indirect call in " f)
    for (i = 1; i <= n; i++) {
        for (g in own) {
            if (index(g, list[i]) == 0) continue
            d = depth(g)
            if (d > deepest) deepest = d
            found[list[i]] = 1
        }
        if (!(list[i] in found)) give_up("there is no function " list[i])
    }
    return deepest
}

END {
    if (failed) exit 1
    if (!("main" in own)) give_up("there is no main")
    for (f in own) {
        if (f !~ /^__vector_[0-9]+$/) continue
        if (2 + depth(f) > interrupt) interrupt = 2 + depth(f)
    }
    print 2 + depth("main"), interrupt + 0, 2 + depth("main") + interrupt
}
