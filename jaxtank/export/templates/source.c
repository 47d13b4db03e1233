#include <math.h>${functions}

const ${real} ${name}_dt = ${dt};${units}
const ${name}_parameters ${name}_defaults = {${values}
};${before}${prepare}

${init}
{
    if (!p) p = &${name}_defaults;${first}
}

${step}
{
    static const ${real} zeros[${longest}] = {0};${given}
    if (!p) p = &${name}_defaults;
    ${unused}${law}
}
