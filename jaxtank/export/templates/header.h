/*
${head}
 *
 * p: the parameters, which may change between two periods (NULL: the defaults);
 * ${zero}: NULL for zeros.${manual}
 */
#ifndef ${NAME}_H
#define ${NAME}_H

#ifdef __cplusplus
extern "C" {
#endif

enum { ${facts} };
typedef ${real} ${name}_real;
extern const ${real} ${name}_dt; /* sampling period [s] */${units}

typedef struct {${fields}
} ${name}_parameters;
extern const ${name}_parameters ${name}_defaults;

typedef struct {
    ${real} s[${NAME}_STATE];${prepared}
} ${name}_state;

${init};
${step};

#ifdef __cplusplus
}
#endif
#endif
